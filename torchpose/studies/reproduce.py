"""All studies, one after the other, into one folder and one report."""

import importlib
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from torchpose.config import parse_json
from torchpose.errors import ConfigError, TorchposeError
from torchpose.io.rows import Row
from torchpose.io.writers import atomic_path
from torchpose.report.files import make_folder
from torchpose.report.html import report
from torchpose.studies.study import RESULT, Progress, StudyResult

# in the order of the paper
STUDIES = (
    "fig02_pnp",
    "table01_orientation",
    "fig04_sensitivity",
    "fig05_shapes",
    "table02_detection",
    "fig06_regions",
    "fig07_subpixel",
    "table03_centers",
    "table04_compensation",
    "fig11_simulation",
    "fig13_experiment",
)
REPORT = "report.html"
_PACKAGES = ("torchpose", "torch", "kornia", "numpy", "opencv-python-headless", "matplotlib")


def reproduce(
    out: Path,
    *,
    full: bool = False,
    seed: int = 0,
    only: Sequence[str] = (),
    resume: bool = False,
    progress: Callable[[str, float], None] = lambda _name, _done: None,
) -> dict[str, str]:
    """Runs the studies and writes ``OUT/NAME/`` for each and ``OUT/report.html``, again after every study.

    Args:
        out: folder of the report.
        full: as many seeds and frames as the documented figures have, instead of a run of some minutes.
        seed: of everything random.
        only: names of `STUDIES`; all by default. What an earlier run left of the others stays in the report.
        resume: keep the studies that an earlier run with the same version, settings and seed finished.
        progress: told the name of the study that runs and the part of it that is done.

    Returns:
        the studies that failed, with the reason. The others are not held up by them.

    Raises:
        ConfigError: ``only`` names no study, or the folder cannot be written.
    """
    unknown = [name for name in only if name not in STUDIES]
    if unknown:
        raise ConfigError(f"{unknown[0]}: --only: is no study; give one of {', '.join(STUDIES)}")
    make_folder(out, "--out")
    failed: dict[str, str] = {}
    for name in STUDIES:
        about = {"study": name, "full": full, "seed": seed, "version": version("torchpose")}
        if (only and name not in only) or (resume and _finished(out / name, about)):
            continue
        progress(name, 0.0)
        try:
            result, record = _run(name, about, partial(progress, name))
        except TorchposeError as error:
            failed[name] = str(error)
        except Exception as error:
            # one study must not cost the results of the others; what happened is kept beside them
            failed[name] = f"{type(error).__name__}: {error}"
            (out / name).mkdir(exist_ok=True)
            (out / name / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
        else:
            result.save(out / name, record)
            _write_report(out, failed)
    _write_report(out, failed)
    return failed


def _run(name: str, about: Row, progress: Progress) -> tuple[StudyResult, Row]:
    """Result of a study, and what its record says besides."""
    study = importlib.import_module(f"torchpose.studies.{name}")
    begun, cpu = time.perf_counter(), time.process_time()
    result = study.run(full=about["full"], seed=about["seed"], progress=progress)
    spent = {"seconds": time.perf_counter() - begun, "cpu_seconds": time.process_time() - cpu}
    return result, about | {"title": study.TITLE} | spent


def _finished(folder: Path, about: Row) -> bool:
    try:
        record = parse_json((folder / RESULT).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(record, dict) and all(record.get(key) == value for key, value in about.items())


def _write_report(out: Path, failed: dict[str, str]) -> None:
    folders = [out / name for name in STUDIES if (out / name / RESULT).exists() and name not in failed]
    with atomic_path(out / REPORT) as temporary:
        temporary.write_text(report(folders, failed, _environment()), encoding="utf-8")


def _environment() -> dict[str, str]:
    """Versions that the figures depend on."""
    found = {"Python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
