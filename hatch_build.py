"""Lets every wheel, an editable one too, carry the page where soft maps are looked at."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

BUNDLE = Path("service") / "viewer" / "bundle.py"


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Bundles the page; where that cannot be done it is said, and everything else is installed."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Run before a wheel is made."""
        done = subprocess.run(
            [sys.executable, str(BUNDLE)], cwd=self.root, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            self.app.display_warning(f"the page is left out ({reason}); to have it: python {BUNDLE}")
