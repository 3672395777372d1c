"""Fig. 11 of the paper: errors of all 875 simulated frames, with the camera known and with a focal length 0.25 % wrong.

python scripts/fig11_simulation.py --out out/fig11 [--blender 29] [--save docs/images/fig11]

--blender N renders every N-th of the 875 frames with Blender (29: 31 frames; 1: all) and estimates them as well. An
interrupted run goes on where it stopped. --save copies the plots and the table, as Markdown, for the documentation.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

from torchpose.analysis.evaluation import Evaluation, estimates_of, evaluate
from torchpose.cli.main import main as torchpose
from torchpose.errors import ConfigError
from torchpose.report.evaluation import plot_consistency, plot_errors
from torchpose.sim import Truth, read_truth
from torchpose.sim.dataset import write_dataset
from torchpose.sim.plan import Plan, load_plan

PLAN = Path(__file__).parents[1] / "configs" / "plans" / "paper_grid.yaml"
FOCAL_ERROR = 1.0025
HEADER = "| frames | axis | bias | spread | rms | largest | claimed sigma | bound sigma |"


def estimated(data: Path, camera: Path, out: Path) -> tuple[Evaluation, Truth]:
    """Poses of a data set under the given camera, evaluated."""
    target = ["--target", str(data / "target.yaml")]
    try:
        torchpose(["estimate", str(data / "frames"), "--camera", str(camera), *target, "--out", str(out), "--resume"])
    except SystemExit as end:
        if end.code:
            raise ConfigError(f"{data}: estimation ended with exit code {end.code}; see above") from None
    rows = {row["frame"]: row for row in map(json.loads, out.read_text(encoding="utf-8").splitlines())}
    truth = read_truth(data / "truth.csv")
    return evaluate(estimates_of([rows[name] for name in truth.frame]), truth), truth


def lines(name: str, result: Evaluation) -> list[str]:
    """Rows of the Markdown table."""
    ok = f"{name}: {result.counts['ok']} of {sum(result.counts.values())} ok, mean NEES {result.nees:.3g}"
    return [
        f"| {ok if i == 0 else ''} | {a.axis}, {a.unit} | {a.bias:.3g} | {a.spread:.3g} | {a.rms:.3g} | {a.worst:.3g} "
        f"| {a.predicted:.3g} | {a.bound:.3g} |"
        for i, a in enumerate(result.axes)
    ]


def run(out: Path, every: int) -> tuple[list[str], dict[str, Evaluation]]:
    """Renders and estimates; the table and the evaluations by name."""
    plan: Plan = load_plan(PLAN)
    write_dataset(plan, out / "analytic", resume=True)
    wrong = replace(plan.camera, matrix=plan.camera.matrix * torch.tensor([[FOCAL_ERROR], [FOCAL_ERROR], [1.0]]))
    # the principal point stays
    wrong.matrix[:2, 2] = plan.camera.matrix[:2, 2]
    wrong.save(out / "camera_wrong_focal.yaml")
    runs = {
        "analytic": ("analytic", out / "analytic" / "camera.yaml"),
        "analytic, focal length 0.25 % too long": ("analytic", out / "camera_wrong_focal.yaml"),
    }
    if every:
        write_dataset(plan.rows(torch.arange(0, len(plan), every)), out / "blender", backend="blender", resume=True)
        runs["Blender"] = ("blender", out / "blender" / "camera.yaml")
    results = {}
    for name, (data, camera) in runs.items():
        table = out / f"poses_{data}{'_wrong_focal' if 'focal' in name else ''}.jsonl"
        results[name], _ = estimated(out / data, camera, table)
    return [HEADER, "| --- " * 8 + "|", *(line for name, r in results.items() for line in lines(name, r))], results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the frames, poses and plots")
    parser.add_argument("--blender", type=int, default=0, metavar="N", help="every N-th frame by Blender as well")
    parser.add_argument("--save", type=Path, help="folder for plots and table besides")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        table, results = run(options.out, options.blender)
    except ConfigError as error:
        print(f"fig11_simulation: error: {error}", file=sys.stderr)
        return 2
    text = "\n".join(table) + "\n"
    print(text)
    for folder in filter(None, (options.out, options.save)):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "table.md").write_text(text, encoding="utf-8")
        for name, result in results.items():
            stem = name.split(",")[0].lower() + ("_wrong_focal" if "focal" in name else "")
            plot_errors(result, name).savefig(folder / f"{stem}_errors.png", dpi=100)
            plot_consistency(result, name).savefig(folder / f"{stem}_consistency.png", dpi=100)
    return 0 if all(r.counts["ok"] == sum(r.counts.values()) for n, r in results.items() if "focal" not in n) else 1


if __name__ == "__main__":
    sys.exit(main())
