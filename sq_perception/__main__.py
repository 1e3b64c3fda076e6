"""``python -m sq_perception``: the command ``sq-perception``."""

from sq_perception.commands.main import main

if __name__ == "__main__":
    raise SystemExit(main())
