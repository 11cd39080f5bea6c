"""The `sceneprint` command as `python -m sceneprint`."""

import sys

from sceneprint.cli import main

sys.exit(main())
