"""`python -m sceneprint` is the `sceneprint` command."""

import sys

from sceneprint.cli import main

sys.exit(main())
