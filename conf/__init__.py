"""The Hydra configuration, a package so that an installed popgen finds it too."""

from pathlib import Path

DIRECTORY = Path(__file__).resolve().parent
