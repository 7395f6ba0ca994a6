"""Stages are taken over from other folders by key, whole or not at all."""

import errno
import os
import shutil

import pytest

from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import create_samples
from reflfield.pipeline.cache import RECORD, StageFolder

OPTIONS = {"side": 5}
FOUR = PhotographedPairs.product(2, 2)


def write_sum(folder):
    """A stage with a file, a folder of files, and the leavings of its blocks."""
    (folder / "sum.txt").write_text("6")
    (folder / "samples" / "c").mkdir(parents=True)
    (folder / "samples" / "c" / "0").write_bytes(b"\1\2")
    # Named like what belongs to the stage alone, but farther down.
    (folder / "samples" / "blocks").write_bytes(b"\3")
    return {"terms": 3}


def refused(folder):
    raise AssertionError(f"{folder}: computed, not taken over")


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def other(tmp_path):
    """A folder in which an earlier process has completed a stage."""
    StageFolder(tmp_path / "other").run("sum", write_sum, options=OPTIONS)
    return StageFolder(tmp_path / "other")


@pytest.fixture
def folder(other, tmp_path):
    return StageFolder(tmp_path / "own", others=[other])


def test_taken_over_with_a_second_name_for_every_file(folder, other):
    made = folder.run("sum", refused, options=OPTIONS)
    assert contents(made) == contents(other.root / "sum")
    assert {"sum.txt", "samples/c/0", "samples/blocks", RECORD} == set(contents(made))
    for name in contents(made):
        assert (made / name).samefile(other.root / "sum" / name)
    (record,) = folder.records
    assert record.counts == {"terms": 3}
    assert record.reused
    assert [path.name for path in folder.root.iterdir()] == ["sum"]


def test_files_are_on_the_disk_before_the_stage_has_its_name(tmp_path, order_of_writes):
    made = StageFolder(tmp_path).run("sum", write_sum, options=OPTIONS)
    for name in contents(made):
        assert order_of_writes(made / name, named=made) == ["flushed", "named"], name


def test_another_key_is_computed(folder, other):
    before = contents(other.root / "sum")
    made = folder.run("sum", write_sum, options={"side": 6})
    assert not (made / "sum.txt").samefile(other.root / "sum" / "sum.txt")
    assert not folder.records[0].reused
    assert contents(other.root / "sum") == before


def test_replaced_here_it_stays_there(folder, other):
    folder.run("sum", refused, options=OPTIONS)
    folder.run("sum", write_sum, options={"side": 6})
    shutil.rmtree(folder.root / "sum")
    StageFolder(folder.root.parent / "third", others=[other]).run(
        "sum", refused, options=OPTIONS
    )


@pytest.mark.parametrize("code", [errno.EXDEV, errno.EPERM, errno.EMLINK])
def test_copied_where_there_are_no_links(folder, other, monkeypatch, code):
    def no_links(source, target):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "link", no_links)
    made = folder.run("sum", refused, options=OPTIONS)
    assert contents(made) == contents(other.root / "sum")
    assert not (made / "sum.txt").samefile(other.root / "sum" / "sum.txt")


@pytest.mark.parametrize("n_links", range(4))
def test_killed_in_between_it_is_taken_over_whole(folder, other, monkeypatch, n_links):
    links, link = [], os.link

    def killed(source, target):
        if len(links) == n_links:
            raise KeyboardInterrupt
        links.append(target)
        link(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(os, "link", killed)
        with pytest.raises(KeyboardInterrupt):
            folder.run("sum", refused, options=OPTIONS)
    assert not (folder.root / "sum").exists()
    # Without the other folder there is nothing whole to take; with it, all of it is.
    alone = StageFolder(shutil.copytree(folder.root, folder.root.parent / "alone"))
    alone.run("sum", write_sum, options=OPTIONS)
    assert not alone.records[0].reused
    made = folder.run("sum", refused, options=OPTIONS)
    assert contents(made) == contents(other.root / "sum")


def test_killed_before_it_takes_its_place_it_is_whole(folder, other, monkeypatch):
    def killed(partial, target):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("reflfield.pipeline.cache.take_place", killed)
        with pytest.raises(KeyboardInterrupt):
            folder.run("sum", refused, options=OPTIONS)
    again = StageFolder(folder.root)
    assert contents(again.run("sum", refused, options=OPTIONS)) == contents(other.root / "sum")


def flipped(path):
    """A file with one bit changed, as old as before."""
    data, status = bytearray(path.read_bytes()), path.stat()
    data[len(data) // 2] ^= 16
    path.write_bytes(data)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


DAMAGES = {
    "one bit": flipped,
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "empty": lambda path: path.write_bytes(b""),
    "gone": lambda path: path.unlink(),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"0"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["sum.txt", "samples/blocks"])
def test_a_damaged_file_is_computed_again_and_said(other, caplog, damage, name):
    damage(other.root / "sum" / name)
    made = other.run("sum", write_sum, options=OPTIONS)
    assert not other.records[0].reused
    assert (made / "sum.txt").read_text() == "6"
    assert f"{made / name}: damaged or gone; the stage 'sum' is computed again" in caplog.text
    # Another run takes it as it is now.
    assert StageFolder(other.root).run("sum", refused, options=OPTIONS) == made


def test_a_damaged_record_is_computed_again_and_said(other, caplog):
    for damage in DAMAGES.values():
        damage(other.root / "sum" / RECORD)
        stages = StageFolder(other.root)
        stages.run("sum", write_sum, options=OPTIONS)
        assert not stages.records[0].reused
    assert caplog.text.count("stage.json: damaged") == len(DAMAGES) - 1  # one was gone


def test_a_damaged_stage_is_not_taken_over(folder, other, caplog):
    flipped(other.root / "sum" / "sum.txt")
    made = folder.run("sum", write_sum, options=OPTIONS)
    assert (made / "sum.txt").read_text() == "6"
    assert not (made / "sum.txt").samefile(other.root / "sum" / "sum.txt")
    assert "sum.txt: damaged or gone" in caplog.text


def test_what_is_wrong_outside_of_the_folder_is_computed_again(other, caplog):
    wrong = lambda folder: "s3://bucket/x: gone"  # noqa: E731
    other.run("sum", write_sum, options=OPTIONS, intact=wrong)
    assert not other.records[0].reused
    assert "s3://bucket/x: gone; the stage 'sum' is computed again" in caplog.text


def write_store(folder):
    """A stage with a store of two chunks."""
    array = create_samples(folder / "samples", 5, FOUR)
    array[:] = 3
    return {}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_computed_again(tmp_path, caplog, damage):
    stages = StageFolder(tmp_path)
    folder = stages.run("observations", write_store)
    chunk = folder / "samples" / "c" / "0" / "0" / "0"
    if damage == "one bit":  # written now, as whatever damages it would
        data = bytearray(chunk.read_bytes())
        data[-9] ^= 1
        chunk.write_bytes(data)
    else:
        DAMAGES[damage](chunk)
    again = StageFolder(tmp_path)
    again.run("observations", write_store)
    assert not again.records[0].reused
    assert "samples/c" in caplog.text
    assert (create_samples(folder / "samples", 5, FOUR)[:] == 3).all()
    StageFolder(tmp_path).run("observations", refused)


def test_a_store_that_was_copied_is_verified_and_used(tmp_path):
    StageFolder(tmp_path / "first").run("observations", write_store)
    shutil.copytree(tmp_path / "first", tmp_path / "second", copy_function=shutil.copyfile)
    StageFolder(tmp_path / "second").run("observations", refused)


def test_an_unfinished_stage_is_not_taken_over(folder, other):
    (other.root / "sum" / RECORD).unlink()
    folder.run("sum", write_sum, options=OPTIONS)
    assert not folder.records[0].reused


def test_computed_again_it_is_taken_over_only_if_that_was_just_done(other, tmp_path):
    stale = StageFolder(tmp_path / "own", {"sum"}, others=[other])
    stale.run("sum", write_sum, options=OPTIONS)
    assert not stale.records[0].reused
    StageFolder(tmp_path / "own").run("sum", refused, options=OPTIONS)
    fresh = StageFolder(tmp_path / "other", {"sum"})
    fresh.run("sum", write_sum, options=OPTIONS)
    own = StageFolder(tmp_path / "own", {"sum"}, others=[fresh])
    made = own.run("sum", refused, options=OPTIONS)
    assert (made / "sum.txt").samefile(fresh.root / "sum" / "sum.txt")
    assert not own.records[0].reused


@pytest.mark.parametrize(
    "failure",
    [
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
        OSError("1000 requested and 0 written"),  # in NumPy's words
    ],
    ids=["system", "numpy"],
)
def test_a_full_disk_is_said_with_the_folder_that_it_holds(tmp_path, failure):
    def full(folder):
        raise failure

    with pytest.raises(OSError, match="No space left on device") as raised:
        StageFolder(tmp_path).run("sum", full, options=OPTIONS)
    assert raised.value.filename == str(tmp_path / "sum.partial")
    assert raised.value.errno == errno.ENOSPC
    assert not (tmp_path / "sum.partial").exists()
