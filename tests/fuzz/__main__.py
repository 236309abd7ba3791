"""Fuzz every reader and the matcher; run as ``python -m fuzz`` in the folder ``tests``.

With atheris (``pip install atheris``) the search is guided by the branches that inputs reach;
without, inputs are damaged at random, the same for the same seed.  An input that a target
cannot take is kept in the folder of findings, one for each place in the code; then the exit
code is 1.  Kernels are compiled to check every index: reading beyond an array is a finding even
where nothing falls.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import io
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

_INTERVAL = 60.0
_MOST_MEGABYTES = 4096


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="all if none is named")
    parser.add_argument("--runs", type=int, default=1_000_000, help="executions a target")
    parser.add_argument("--seconds", type=int, default=3600, help="at most so long a target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engine", choices=("atheris", "random"))
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"), metavar="DIR")
    parser.add_argument("--input", type=Path, help="give one finding to the one target named")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.engine = options.engine or _best_engine()
    if options.alone:
        return _fuzz(options.targets[0], options)
    from .targets import TARGETS, execute

    if unknown := set(options.targets) - set(TARGETS):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join(TARGETS)}")
    if options.input is not None:
        with tempfile.TemporaryDirectory() as folder:
            execute(TARGETS[options.targets[0]], options.input.read_bytes(), Path(folder))
        return 0
    codes = [_start(name, options) for name in options.targets or TARGETS]
    return int(any(codes))


def _best_engine() -> str:
    return "random" if importlib.util.find_spec("atheris") is None else "atheris"


def _start(name: str, options: argparse.Namespace) -> int:
    """Fuzz a target in a process of its own, which atheris ends as it likes."""
    words = [sys.executable, "-m", "fuzz", name, "--alone", "--engine", options.engine]
    for word in ("runs", "seconds", "seed", "findings"):
        words += [f"--{word}", str(getattr(options, word))]
    with tempfile.TemporaryDirectory() as folder:  # kernels that check are not those of every day
        checked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": folder}
        return subprocess.run(words, env=os.environ | checked, check=False).returncode


def _fuzz(name: str, options: argparse.Namespace) -> int:
    warnings.simplefilter("ignore")
    logging.disable()
    fuzz = _with_atheris if options.engine == "atheris" else _at_random
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as folder:
        return fuzz(name, options, Path(folder))


def _memory_folder() -> str | None:
    """A folder that costs no disk, where there is one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


class _Runner:
    """Executes inputs, counts, and keeps those that a target cannot take."""

    def __init__(self, name: str, options: argparse.Namespace, folder: Path) -> None:
        from .targets import TARGETS, execute

        self._execute = execute
        self._target = TARGETS[name]
        self._findings = options.findings
        self._runs, self._seconds = options.runs, options.seconds
        self._folder = folder
        self._places: set[str] = set()
        self.seeds = self._target.seeds()
        for seed in self.seeds:  # what is loaded and compiled once is nobody's fault
            self._target.check(seed, folder)
        self._count = 0
        self._begin = self._told = time.monotonic()

    def take(self, data: bytes) -> None:
        """Execute one input."""
        self._count += 1
        try:
            self._execute(self._target, data, self._folder)
        except Exception as error:
            self._keep(data, error)
        if time.monotonic() - self._told > _INTERVAL:
            self._told = time.monotonic()
            self.tell()

    def tell(self) -> None:
        """Say how many executions, how fast, with how many findings."""
        seconds = time.monotonic() - self._begin
        print(
            f"{self._target.name}: {self._count} executions in {seconds:.0f} s, "
            f"{self._count / max(seconds, 1e-9):.0f}/s, {len(self._places)} findings",
            flush=True,
        )

    @property
    def is_done(self) -> bool:
        """Whether the budget is spent."""
        return self._count >= self._runs or time.monotonic() - self._begin >= self._seconds

    @property
    def found(self) -> bool:
        """Whether there was an input that the target could not take."""
        return bool(self._places)

    def _keep(self, data: bytes, error: Exception) -> None:
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{type(error).__name__} {frames[-1].filename}:{frames[-1].lineno}"
        if place in self._places:
            return
        self._places.add(place)
        self._findings.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha1(place.encode(), usedforsecurity=False).hexdigest()[:8]
        path = self._findings / f"{self._target.name}-{digest}"
        path.write_bytes(data)
        said = "".join(traceback.format_exception(error))
        path.with_suffix(".txt").write_text(said, encoding="utf-8", errors="backslashreplace")
        print(f"{self._target.name}: {place}: {str(error)[:200]!a}, kept in {path}", flush=True)


def _at_random(name: str, options: argparse.Namespace, folder: Path) -> int:
    from .mutation import mutated
    from .targets import TARGETS

    runner = _Runner(name, options, folder)
    rng = random.Random(options.seed)
    words = TARGETS[name].words
    while not runner.is_done:
        runner.take(mutated(rng, runner.seeds, words))
    runner.tell()
    return int(runner.found)


def _with_atheris(name: str, options: argparse.Namespace, folder: Path) -> int:
    import atheris

    with (
        contextlib.redirect_stderr(io.StringIO()),  # it names every module
        atheris.instrument_imports(["anchorscan"], _with_kernels()),
    ):
        from .targets import TARGETS
    runner = _Runner(name, options, folder)
    corpus, words = folder / "corpus", folder / "words"
    corpus.mkdir()
    for number, seed in enumerate(runner.seeds):
        (corpus / f"seed{number}").write_bytes(seed)
    words.write_text("".join(f'"{_escaped(word)}"\n' for word in TARGETS[name].words))
    options.findings.mkdir(parents=True, exist_ok=True)
    arguments = [
        "fuzz",
        str(corpus),
        f"-dict={words}",
        f"-max_len={2 * max(map(len, runner.seeds))}",
        f"-rss_limit_mb={_MOST_MEGABYTES}",
        f"-seed={options.seed}",
        f"-artifact_prefix={options.findings.absolute()}/{name}-stopped-",
        "-verbosity=0",
        "-timeout=900",
    ]

    def take(data: bytes) -> None:
        runner.take(data)
        if runner.is_done:  # atheris itself would end without a word
            runner.tell()
            shutil.rmtree(folder, ignore_errors=True)
            os._exit(int(runner.found))

    atheris.Setup(arguments, take)
    atheris.Fuzz()
    return 0


def _with_kernels() -> list[str]:
    """Modules that numba compiles from their bytecode, which therefore must stay as it is."""
    home = Path(next(iter(importlib.util.find_spec("anchorscan").submodule_search_locations)))
    texts = {path: path.read_text(encoding="utf-8") for path in home.glob("*.py")}
    return [f"anchorscan.{path.stem}" for path, text in texts.items() if "_jit" in text]


def _escaped(word: bytes) -> str:
    return "".join(f"\\x{byte:02X}" for byte in word)


if __name__ == "__main__":
    sys.exit(main())
