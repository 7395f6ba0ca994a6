"""The command ``reflfield``, ready for Ctrl-C before the libraries are imported."""

from reflfield.util.interrupts import ending_on_signals


def main() -> None:
    """Run the command; see `reflfield.cli`."""
    with ending_on_signals():
        from reflfield.cli import main as command

        command()


if __name__ == "__main__":
    main()
