"""What one machine and a Ray cluster on it do: frames a second, lost nodes, a store that fails now and then.

    python scripts/bench_scale.py throughput [--frames 2000]     # workers of one core, beside the local engine
    python scripts/bench_scale.py loss [--runs 20]               # two of three nodes killed at random moments
    python scripts/bench_scale.py store [--frames 10000]         # an S3 server on the loopback, 2 % of requests fail

Figures of docs/scale.md. Needs the extras ray and dev. Commands run as a user types them, in processes of their own.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchpose.io.rows import POSE_SCHEMA, Row
from torchpose.io.writers import read_table

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
SAMPLE = ROOT / "data" / "sample"
SMALL = 320, 240  # px, of the frames of the store


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("throughput", "loss", "store"))
    parser.add_argument("--frames", type=int, help="by default 2000, 400 and 10000")
    parser.add_argument("--runs", type=int, default=20, help="of loss")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        {"throughput": throughput, "loss": loss, "store": store}[arguments.what](Path(folder), arguments)


def command(frames: str | Path, out: str | Path, *options: str, sample: Path = SAMPLE) -> list[str]:
    files = ["--camera", str(sample / "camera.yaml"), "--target", str(sample / "target.yaml")]
    return [sys.executable, "-m", "torchpose", "estimate", str(frames), *files, "--out", str(out), "-q", *options]


def timed(arguments: Sequence[str]) -> float:
    """Seconds of a command that succeeds."""
    start = time.perf_counter()
    subprocess.run(arguments, check=True, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


def linked(folder: Path, count: int) -> Path:
    """So many frames of 2 MP: the sample's, over and over."""
    folder.mkdir()
    pictures = sorted((SAMPLE / "frames").iterdir())
    for number in range(count):
        (folder / f"{number:05d}.png").symlink_to(pictures[number % len(pictures)])
    return folder


def rows(path: Path) -> list[Row]:
    return read_table(path, POSE_SCHEMA, ["frame"])


def throughput(folder: Path, arguments: argparse.Namespace) -> None:
    """Frames a second of one and two workers, start and end of the cluster left out by a run of few frames."""
    count = arguments.frames or 2000
    many, few = linked(folder / "many", count), linked(folder / "few", 32)
    seconds: dict[str, float] = {}
    for name, options in {
        "local, 2 threads": ["--threads", "2"],
        "local, 1 thread": ["--threads", "1"],
        "ray, 1 worker": ["--engine", "ray", "--threads", "1"],
        "ray, 2 workers": ["--engine", "ray", "--threads", "2"],
    }.items():
        taken = []
        for number, frames in enumerate((few, many)):
            taken.append(timed(command(frames, folder / f"{name}{number}.parquet", *options)))
        seconds[name] = taken[1] - taken[0]
        print(f"{name}: {(count - 32) / seconds[name]:.1f} frames/s ({taken[1]:.0f} s in all, {taken[0]:.0f} s of 32)")
    print(f"two workers over one: {seconds['ray, 1 worker'] / seconds['ray, 2 workers']:.2f}")
    print(f"ray over local, two cores: {seconds['ray, 2 workers'] / seconds['local, 2 threads']:.2f} of its time")
    own, other = rows(folder / "local, 1 thread1.parquet"), rows(folder / "ray, 2 workers1.parquet")
    by_name = {row["frame"]: row for row in other}
    print(f"rows equal to the last digit: {sum(by_name.get(row['frame']) == row for row in own)} of {count}")


def loss(folder: Path, arguments: argparse.Namespace) -> None:
    """Runs of which two of three nodes are killed, each at a random moment."""
    from ray.cluster_utils import Cluster

    draw, count = random.Random(arguments.seed), arguments.frames or 400
    frames, whole = linked(folder / "frames", count), Counter[str]()
    for run in range(arguments.runs):
        cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
        out = folder / f"{run}.parquet"
        options = ["--engine", "ray", "--batch", "4", "--method", "centers"]
        task = subprocess.Popen(command(frames, out, *options, "--address", cluster.address))
        moments = sorted(draw.uniform(5, 40) for _ in nodes)
        start = time.perf_counter()
        for node, moment in zip(nodes, moments, strict=True):
            time.sleep(max(0.0, moment - (time.perf_counter() - start)))
            whole["killed while it ran"] += task.poll() is None
            cluster.remove_node(node, allow_graceful=False)
        code = task.wait()
        whole["completed by itself"] += code == 0
        cluster.shutdown()
        if code != 0:
            whole["completed by --resume"] += subprocess.run(command(frames, out, *options, "--resume")).returncode == 0
        found = Counter(row["frame"] for row in rows(out))
        whole["rows lost"] += count - len(found)
        whole["rows twice"] += sum(found.values()) - len(found)
        print(
            f"run {run}: killed after {', '.join(f'{m:.0f}' for m in moments)} s, exit {code}: {dict(whole)}",
            flush=True,
        )


def store(folder: Path, arguments: argparse.Namespace) -> None:
    """Small frames from and to a store; memory of the driver with a tenth of them and with all."""
    import cv2

    from tests.io.stores import ENVIRONMENT, s3_server
    from torchpose.io.storage import Place

    count, picture = arguments.frames or 10000, cv2.imencode(".png", small_sample(folder))[1].tobytes()
    with s3_server("cell", every=50) as (url, application):
        os.environ.update(ENVIRONMENT | {"AWS_ENDPOINT_URL": url})
        for share in (10, 1):
            for number in range(count // share):
                (Place(f"s3://cell/{share}") / f"{number:06d}.png").write(picture)
            before = application.asked, application.failed
            out = Place(f"s3://cell/out/{share}.parquet")
            driver = command(f"s3://cell/{share}", str(out), "--engine", "ray", "--threads", "2", sample=folder)
            start = time.perf_counter()
            _, status, used = os.wait4(subprocess.Popen(driver).pid, 0)
            table = folder / f"{share}.parquet"
            table.mkdir()
            for one in out.listed():
                (table / one.name).write_bytes((out / one.name).read(1 << 30))
            found = Counter(row["frame"] for row in rows(table))
            print(
                f"{count // share} frames: exit {os.waitstatus_to_exitcode(status)}, "
                f"{time.perf_counter() - start:.0f} s, "
                f"{len(found)} of them have rows, {sum(found.values()) - len(found)} twice, "
                f"{application.failed - before[1]} of {application.asked - before[0]} requests failed, "
                f"driver {used.ru_maxrss // 1024} MB",
                flush=True,
            )


def small_sample(folder: Path) -> np.ndarray:
    """A small frame, with camera.yaml and target.yaml beside it."""
    import torch

    from torchpose.camera import Camera
    from torchpose.sim import add_noise, render
    from torchpose.target import Target

    width, height = SMALL
    matrix = torch.tensor([[500.0, 0, (width - 1) / 2], [0, 500, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    camera, target = Camera(width, height, matrix, torch.zeros(5, dtype=torch.float64)), Target.load("quad40")
    camera.save(folder / "camera.yaml")
    target.save(folder / "target.yaml")
    pose = torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0, 180]], dtype=torch.float64)
    frame: np.ndarray = add_noise(render(camera, target, *pose), 1.0)[0].numpy()
    return frame


if __name__ == "__main__":
    print(json.dumps({"cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()}))
    main()
