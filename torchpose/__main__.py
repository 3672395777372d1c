"""``python -m torchpose``."""

from torchpose.cli.main import main

if __name__ == "__main__":
    main()
