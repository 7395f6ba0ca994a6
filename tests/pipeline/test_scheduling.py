"""Blocks: the same results whoever computes them, kept as they finish, found if damaged."""

import threading
import time

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from reflfield.errors import InputError
from reflfield.pipeline.stage import Stage
from reflfield.util.blas_threads import one_core_blas, thread_pool
from reflfield.util.blocks import BlockFiles, Blocks, Scheduler, Tally
from reflfield.util.progress import listening


def square(context, block):
    """A block of the tests."""
    return {"square": np.array(context * block**2)}


class Fails:
    """Function of blocks that fails at one of them, and remembers all."""

    def __init__(self, at):
        self.at, self.seen = at, []

    def __call__(self, context, block):
        self.seen.append(block)
        if block == self.at:
            raise InputError(f"block {block}: damaged")
        return square(context, block)


class TestBlocks:
    @pytest.mark.parametrize("workers", [1, 3])
    def test_results_come_in_the_order_of_the_blocks(self, tmp_path, workers):
        blocks = Blocks(Scheduler(workers), tmp_path)
        results = blocks.map("squares", square, 2, [5, 3, 4, 1])
        assert [int(arrays["square"]) for arrays in results] == [50, 18, 32, 2]
        assert blocks.tally == Tally(computed=4)

    def test_what_is_there_is_not_computed_again(self, tmp_path):
        first = Fails(at=3)
        blocks = Blocks(Scheduler(), tmp_path)
        with pytest.raises(InputError, match="block 3: damaged"):
            blocks.map("squares", first, 2, list(range(6)))
        finished = set(first.seen) - {3}
        again, tally = Fails(at=None), Tally()
        results = Blocks(Scheduler(2), tmp_path, tally).map("squares", again, 2, list(range(6)))
        assert sorted(again.seen) == sorted(set(range(6)) - finished)
        assert tally == Tally(computed=6 - len(finished), resumed=len(finished))
        assert [int(arrays["square"]) for arrays in results] == [2 * n * n for n in range(6)]

    @pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
    def test_damaged_results_are_computed_again(self, tmp_path, damage):
        blocks = Blocks(Scheduler(), tmp_path)
        blocks.map("squares", square, 2, [1, 2, 3])
        path = BlockFiles(tmp_path / "squares").path(1)
        data = path.read_bytes()
        changed = data[:-50] + bytes([data[-50] ^ 1]) + data[-49:]
        path.write_bytes({"cut": data[:-9], "changed": changed, "empty": b""}[damage])
        again = Fails(at=None)
        results = blocks.map("squares", again, 2, [1, 2, 3])
        assert again.seen == [2]
        assert int(results[1]["square"]) == 8

    def test_results_whose_other_traces_are_gone_are_computed_again(self, tmp_path):
        blocks = Blocks(Scheduler(2), tmp_path)
        blocks.map("squares", square, 2, [1, 2, 3])
        again = Fails(at=None)
        blocks.map("squares", again, 2, [1, 2, 3], intact=lambda context, block: block != 3)
        assert again.seen == [3]

    def test_one_step_is_kept_too(self, tmp_path):
        calls = []

        def step():
            calls.append(1)
            return {"found": np.arange(3)}

        blocks = Blocks(Scheduler(), tmp_path)
        for _ in range(2):
            assert blocks.once("step", step)["found"].tolist() == [0, 1, 2]
        assert calls == [1]

    def test_threads_work_at_the_same_time_but_not_more_than_allowed(self, tmp_path):
        working, most = [], []

        def wait(context, block):
            working.append(block)
            most.append(len(working))
            time.sleep(0.05)
            working.remove(block)
            return {"thread": np.array(threading.get_ident())}

        results = Blocks(Scheduler(3), tmp_path).map("free", wait, None, range(6))
        assert max(most) > 1
        assert len({int(arrays["thread"]) for arrays in results}) == 3
        most.clear()
        Blocks(Scheduler(3), tmp_path).map("one", wait, None, range(3), at_once=1)
        assert max(most) == 1

    def test_progress_counts_what_was_there(self, tmp_path):
        blocks, heard = Blocks(Scheduler(), tmp_path), []
        blocks.map("squares", square, 1, [0, 1, 2])
        BlockFiles(tmp_path / "squares").path(2).unlink()
        with listening(lambda *words: heard.append(words)):
            blocks.map("squares", square, 1, [0, 1, 2])
        assert heard == [("squares", 2, 3), ("squares", 3, 3)]

    def test_progress_of_works_at_the_same_time_is_told_apart(self, tmp_path):
        """As in a program of one's own that runs two captures in two threads."""
        heard = {"one": [], "two": []}
        both = threading.Barrier(2)

        def work(name):
            def wait(context, block):
                both.wait(10)
                return {"block": np.array(block)}

            with listening(lambda *words: heard[name].append(words)):
                Blocks(Scheduler(), tmp_path / name).map(name, wait, None, range(5))

        threads = [threading.Thread(target=work, args=(name,)) for name in heard]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for name, words in heard.items():
            assert words == [(name, n, 5) for n in range(6)]

    def test_after_an_error_no_more_blocks_are_begun(self, tmp_path):
        failing = Fails(at=0)
        with pytest.raises(InputError, match="block 0: damaged"):
            Blocks(Scheduler(), tmp_path).map("squares", failing, 2, range(2000))
        assert len(failing.seen) < 1000

    def test_a_result_that_vanishes_is_named(self, tmp_path):
        results = Blocks(Scheduler(), tmp_path).map("squares", square, 1, [1, 2])
        BlockFiles(tmp_path / "squares").path(1).unlink()
        with pytest.raises(InputError, match=r"000001.block: expected the block"):
            results.joined("square")


def blas_threads():
    """Most threads that any BLAS of this process would use."""
    return max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")


def test_blas_has_its_threads_back_when_holders_of_the_limit_overlap():
    with threadpool_limits(limits=2, user_api="blas"):
        first, second = one_core_blas(), one_core_blas()
        first.__enter__()
        second.__enter__()
        assert blas_threads() == 1
        first.__exit__(None, None, None)
        assert blas_threads() == 1
        second.__exit__(None, None, None)
        assert blas_threads() == 2


def test_threads_of_a_pool_have_one_of_the_blas_each():
    with threadpool_limits(limits=2, user_api="blas"):
        with thread_pool(0) as pool:  # at least one
            assert pool.submit(blas_threads).result() == 1
        assert blas_threads() == 2


@pytest.mark.parametrize("large_products", [False, True])
def test_blas_has_threads_in_stages_with_large_products_alone(large_products, tmp_path):
    found = []

    def compute(context, folder):
        found.append(blas_threads())
        return {}

    stage = Stage("some", compute, large_products=large_products)
    with threadpool_limits(limits=2, user_api="blas"):
        stage._computed(None, tmp_path)
        assert blas_threads() == 2
    assert found == [2 if large_products else 1]
