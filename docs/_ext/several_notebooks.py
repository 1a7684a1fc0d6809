"""Executes the notebooks that a build needs, several at a time, into the cache from which myst_nb then takes them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

from jupyter_cache import get_cache
from jupyter_cache.base import CacheBundleIn
from myst_nb.core.read import create_nb_reader
from nbclient import NotebookClient
from nbformat import NotebookNode
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from traitlets.config import Config


def execute_some(app: Sphinx, env: BuildEnvironment, names: Sequence[str]) -> None:
    """Executes what is not in the cache; what fails is executed again where its page is read, which reports it."""
    if app.config.nb_execution_mode != "cache":
        return
    cache = get_cache(app.config.nb_execution_cache_path)
    found: list[tuple[Path, NotebookNode]] = []
    for name in names:
        path = Path(env.doc2path(name))
        text = path.read_text(encoding="utf-8")
        reader = create_nb_reader(str(path), env.myst_config, env.mystnb_config, text)
        if reader is None:
            continue
        notebook = reader.read(text)
        try:
            cache.match_cache_notebook(notebook)
        except KeyError:
            found.append((path, notebook))
    found.sort(key=lambda each: -len(each[1].cells))  # the longest do not begin last
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {pool.submit(executed, app, notebook): (path, notebook) for path, notebook in found}
        for done in as_completed(running):
            path, notebook = running[done]
            if done.exception() is not None:
                print(f"{path.name} failed beside the others, and is executed again: {done.exception()}")
                continue
            bundle = CacheBundleIn(notebook, str(path), data={"execution_seconds": done.result()})
            cache.cache_notebook_bundle(bundle, check_validity=False, overwrite=True)


def executed(app: Sphinx, notebook: NotebookNode) -> float:
    """Executes a notebook, in a folder and with a store of data sets of its own, and gives the seconds."""
    begun = monotonic()
    with TemporaryDirectory() as folder, TemporaryDirectory(prefix="mpcoffline-docs-") as own:
        # Sockets that are files in its own folder: a port that is free now may be taken when the kernel wants it.
        sockets = {"transport": "ipc", "connection_file": str(Path(own) / "kernel.json")}
        client = NotebookClient(
            notebook,
            timeout=app.config.nb_execution_timeout,
            record_timing=False,  # what is in the cells is a key of the cache
            resources={"metadata": {"path": folder}},
            config=Config(KernelManager=sockets),
        )
        client.execute(env=os.environ | {"MINARI_DATASETS_PATH": str(Path(own) / "store")})
    return monotonic() - begun


def setup(app: Sphinx) -> dict[str, bool]:
    """Before pages are read."""
    app.connect("env-before-read-docs", execute_some)
    return {"parallel_read_safe": True}
