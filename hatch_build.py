"""The long description of the package: README.md, with links that hold on PyPI, where none of the repository's files lie.

The repository's address stands once, in ``[project.urls]`` of pyproject.toml.
"""

from __future__ import annotations

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)(\[[^\]]*\])\((?!https?://|#)([^)]+)\)")
"""A Markdown link or picture whose target is a file of the repository."""
PICTURE = re.compile(r'(<img src=")(?!https?://)([^"]+)')
"""The same of a picture that has a width."""


def absolute(text: str, repository: str, ref: str) -> str:
    """Links to files become links to them in the repository, pictures become links to their bytes."""
    kinds = {"!": "raw", "": "blob"}
    text = LINK.sub(lambda m: f"{m[1]}{m[2]}({repository}/{kinds[m[1]]}/{ref}/{m[3]})", text)
    return PICTURE.sub(lambda m: f"{m[1]}{repository}/raw/{ref}/{m[2]}", text)


class Readme(MetadataHookInterface):
    """Hatchling asks it for what pyproject.toml calls dynamic."""

    def update(self, metadata: dict) -> None:
        """Add the description of this version; its pictures are those of its tag."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        tag = f"v{metadata['version']}" if "version" in metadata else "main"
        text = absolute(text, metadata["urls"]["Repository"], tag)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
