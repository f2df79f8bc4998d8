"""`python -m cellctl` and the `cellctl` command."""

from __future__ import annotations

import sys

from cellctl.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
