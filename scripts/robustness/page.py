"""Pages that several scripts write, each its own part of one."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from pathlib import Path

TITLE = "# Hostile files and interruptions, measured"
PARTS = ("Hostile files", "Interruptions")
LIMITS_TITLE = "# Limits, measured"
LIMITS = ("Speed", "Agreement", "Random problems", "Hostile problems", "Plants")


def heading(script: str) -> list[str]:
    """Where and when it was measured."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    versions = {name: importlib.metadata.version(name) for name in ("minari", "h5py", "numpy", "torch", "casadi")}
    return [
        f"`scripts/{script} --full`, on {time.strftime('%Y-%m-%d')}: {cpu}, {os.cpu_count()} cores"
        f" (load {os.getloadavg()[0]:.1f} at the end),",
        f"Python {platform.python_version()}, {', '.join(f'{k} {v}' for k, v in versions.items())}.",
    ]


def write_part(path: Path, part: str, lines: list[str], *, title: str = TITLE, names: tuple[str, ...] = PARTS) -> None:
    """Replaces one part of a page; the others stay.

    Args:
        path: The page, which may not exist yet.
        part: One of the names.
        lines: Its content, without its own heading.
        title: Of the page.
        names: Of its parts, in their order.
    """
    parts = dict.fromkeys(names, "")
    if path.exists():
        for text in path.read_text(encoding="utf-8").split("\n## ")[1:]:
            name, _, content = text.partition("\n")
            if name in parts:
                parts[name] = content.strip("\n")
    parts[part] = "\n".join(lines).strip("\n")
    sections = [f"## {name}\n\n{content}\n" for name, content in parts.items() if content]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([title, "", *sections]), encoding="utf-8")
