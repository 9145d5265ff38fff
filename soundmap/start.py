"""Where the ``soundmap`` command starts: it may be stopped while the program is still loading."""


def main() -> None:
    """Entry point of the ``soundmap`` command."""
    try:
        from soundmap.cli import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()
