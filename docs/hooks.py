"""Hooks of the site: sources for the API pages, and links to files of the repository."""

from __future__ import annotations

import importlib.util
import posixpath
import re
import shutil
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "build" / "docs"
LINK = re.compile(r"(!?\[[^\]]*\]\()(\.\./[^)\s#]+)(#[^)\s]*)?\)")


def on_startup(**_: Any) -> None:
    """Copy the package and the stub of its compiled part to where mkdocstrings reads them."""
    package = SOURCES / "protomark"
    shutil.rmtree(SOURCES, ignore_errors=True)
    ignored = shutil.ignore_patterns("__pycache__", "*.so", "*.pme", "*.safetensors", "*.png")
    shutil.copytree(ROOT / "python" / "protomark", package, ignore=ignored)
    spec = importlib.util.find_spec("protomark")
    stubs = [Path(p) / "_core.pyi" for p in (spec and spec.submodule_search_locations) or []]
    stub = next((path for path in stubs if path.is_file()), package / "_core.pyi")
    if not stub.is_file():
        raise PluginError("protomark is not installed here: its compiled part has no stub")
    text = stub.read_text(encoding="utf-8")
    # The last overload of a function has its docstring; a page shows that one.
    text = re.sub(r"@overload\ndef .*: \.\.\.\n(?=@overload)", "", text).replace("@overload\n", "")
    (package / "_core.pyi").write_text(text, encoding="utf-8")


def on_page_markdown(markdown: str, *, page: Any, config: Any, **_: Any) -> str:
    """Turn relative links that leave docs/ into links to the repository."""
    folder = posixpath.dirname(posixpath.join("docs", page.file.src_uri))

    def absolute(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, match[2]))
        if path.startswith("docs/"):
            return match[0]
        if not (ROOT / path).exists():
            raise PluginError(f"{page.file.src_uri}: {match[2]} is not in the repository")
        return f"{match[1]}{config.repo_url}/blob/main/{path}{match[3] or ''})"

    return LINK.sub(absolute, markdown)
