"""What one machine and a Ray cluster on it do: frames a second, lost nodes, a store that fails; what a day costs.

    python scripts/bench_scale.py throughput [--frames 2000]     # workers of one core beside local ones: 5 minutes
    python scripts/bench_scale.py loss [--runs 20]               # two of three nodes killed at random moments
    python scripts/bench_scale.py store [--frames 10000]         # an S3 server on the loopback, 2 % of requests fail
    python scripts/bench_scale.py costs --price 0.05             # of a million to a billion frames, by arithmetic
    python scripts/bench_scale.py costs --into docs/scale.md     # the tables of that page

Figures of docs/scale.md. Needs the extras ray and dev. Commands run as a user types them, in processes of their own.
`throughput` keeps what it measures in docs/benchmarks/scale.json (--figures), which `costs` reads.
"""

import argparse
import contextlib
import json
import logging
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose.camera import Camera
from torchpose.io.rows import POSE_SCHEMA, Row
from torchpose.io.storage import Place
from torchpose.io.writers import read_table

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
SAMPLE = ROOT / "data" / "sample"
FIGURES = ROOT / "docs" / "benchmarks" / "scale.json"
BATCH = 16  # frames of 2 MP, `torchpose.io.reader.default_batch`
SMALL = 320, 240  # px, of the frames of the store


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("throughput", "loss", "store", "costs"))
    parser.add_argument("--frames", type=int, help="by default 2000, 400 and 10000")
    parser.add_argument("--runs", type=int, default=20, help="of loss")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--figures", type=Path, default=FIGURES, help="what throughput measures, for costs")
    parser.add_argument("--price", type=float, default=0.05, help="of a core-hour, in your currency, for costs")
    parser.add_argument("--into", type=Path, help="page that costs writes its tables into, by default prints them")
    arguments = parser.parse_args()
    arguments.load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        {"throughput": throughput, "loss": loss, "store": store, "costs": costs}[arguments.what](
            Path(folder), arguments
        )


def command(frames: str | Path, out: str | Path, *options: str, sample: Path = SAMPLE) -> list[str]:
    files = ["--camera", str(sample / "camera.yaml"), "--target", str(sample / "target.yaml")]
    return [sys.executable, "-m", "torchpose", "estimate", str(frames), *files, "--out", str(out), "-q", *options]


def linked(folder: Path, count: int) -> Path:
    """So many frames of 2 MP: the sample's, over and over."""
    folder.mkdir()
    pictures = sorted((SAMPLE / "frames").iterdir())
    for number in range(count):
        (folder / f"{number:05d}.png").symlink_to(pictures[number % len(pictures)])
    return folder


def rows(path: Path) -> list[Row]:
    return read_table(path, POSE_SCHEMA, ["frame"])


def busy_seconds() -> float:
    """Core seconds that this machine has worked so far, at nice 0 or above; NaN where that is not told."""
    try:
        user, _, system = Path("/proc/stat").read_text().split()[1:4]
    except OSError:
        return float("nan")
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def worker_bytes() -> int:
    """Resident set of the largest worker of Ray that runs here."""
    largest = 0
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):
            if (process / "cmdline").read_bytes().startswith(b"ray::MapWorker"):
                pages = int((process / "statm").read_text().split()[1])
                largest = max(largest, pages * os.sysconf("SC_PAGE_SIZE"))
    return largest


def peak_mb(process: int) -> int:
    """Largest resident set so far of a process that runs, MB; 0 where there is none."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) >> 10
    return 0


class Run(NamedTuple):
    """Of a command: seconds, cores that were busy meanwhile, largest resident sets of it and of a worker of Ray, MB."""

    seconds: float
    cores: float
    mb: int
    worker_mb: int


def timed(arguments: Sequence[str]) -> Run:
    """A command that comes to its end, if with frames that could not be read."""
    start, busy, own, worker = time.perf_counter(), busy_seconds(), 0, 0
    with subprocess.Popen(arguments) as process:
        while process.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(1.0)
            own, worker = max(own, peak_mb(process.pid)), max(worker, worker_bytes() >> 20)
    if process.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(arguments)}: exit {process.returncode}")
    taken = time.perf_counter() - start
    return Run(taken, (busy_seconds() - busy) / taken, own, worker)


ENGINES = {
    "local, 1 core": ["--threads", "1"],
    "local, 2 cores": ["--threads", "2"],
    "ray, 1 worker": ["--engine", "ray", "--threads", "1"],
    "ray, 2 workers": ["--engine", "ray", "--threads", "2"],
}


def throughput(folder: Path, arguments: argparse.Namespace) -> None:
    """Frames a second of one and two cores by both engines: of the whole command, and without its start and end.

    Without: by what a run of many frames takes beyond one of few, which are two batches, one for each of two workers.
    """
    count, few = arguments.frames or 2000, 2 * BATCH
    many, little = linked(folder / "many", count), linked(folder / "few", few)
    engines: dict[str, dict[str, float]] = {}
    for name, options in ENGINES.items():
        short, long = (timed(command(f, folder / f"{name}{f.name}.parquet", *options)) for f in (little, many))
        rate = (count - few) / (long.seconds - short.seconds)
        engines[name] = {
            "frames/s": round(rate, 1),
            "of the whole command": round(count / long.seconds, 1),
            "start and end, s": round(long.seconds - count / rate, 1),
            "busy cores": round(long.cores, 2),
            "MB": long.worker_mb or long.mb,
        }
        print(f"{name}: {engines[name]}", flush=True)
    own = rows(folder / f"local, 1 core{many.name}.parquet")
    parts = folder / f"ray, 2 workers{many.name}.parquet"
    same = {row["frame"]: row for row in rows(parts)}
    camera = Camera.load(SAMPLE / "camera.yaml")
    measured = {
        "frames": count,
        "load before": round(arguments.load, 2),
        "engines": engines,
        "rows equal to the last digit": sum(same.get(row["frame"]) == row for row in own),
        "megapixels": round(camera.width * camera.height / 1e6, 1),
        "bytes a picture": sum(path.stat().st_size for path in many.iterdir()) // count,
        "bytes a row": sum(path.stat().st_size for path in parts.iterdir()) // count,
    }
    arguments.figures.write_text(json.dumps(measured, indent=1) + "\n")
    print("\n" + "\n".join(measured_lines(measured)))


def measured_lines(measured: Mapping[str, Any]) -> list[str]:
    """What `throughput` found, as Markdown."""
    engines, count = measured["engines"], measured["frames"]
    columns = list(next(iter(engines.values())))
    lines = [
        f"| {count} frames of {measured['megapixels']} MP | {' | '.join(columns)} |",
        "|---" * (len(columns) + 1) + "|",
    ]
    lines += [f"| {name} | {' | '.join(str(value) for value in found.values())} |" for name, found in engines.items()]
    lines.append("")
    for column in columns[:2]:
        rate = {name: found[column] for name, found in engines.items()}
        gain = rate["ray, 2 workers"] / rate["ray, 1 worker"]
        time_taken = rate["local, 2 cores"] / rate["ray, 2 workers"]
        lines.append(
            f"- {column}: two workers over one {gain:.2f} (at least 1.7 wanted), time of two workers over that of two "
            f"local cores {time_taken:.2f} (at most 1.15 wanted)."
        )
    lines.append(f"- Rows equal to the last digit: {measured['rows equal to the last digit']} of {count}.")
    return [*lines, f"- Load of the machine before: {measured['load before']}."]


class Needs(NamedTuple):
    """Of a day of frames: cores, their memory in GB, what stores send (MB/s, pictures/s) and keep (GB), price."""

    cores: int
    memory: float
    bandwidth: float
    pictures: float
    rows: float
    price: float


def needs(frames: int, measured: Mapping[str, Any], price: float) -> Needs:
    """Of so many frames a day, by arithmetic from what `throughput` has measured and the price of a core-hour."""
    rate, a_second = measured["engines"]["ray, 2 workers"]["frames/s"] / 2, frames / 86400
    cores = math.ceil(a_second / rate)
    return Needs(
        cores,
        cores * measured["engines"]["ray, 2 workers"]["MB"] / 1e3,
        a_second * measured["bytes a picture"] / 1e6,
        a_second,
        frames * measured["bytes a row"] / 1e9,
        a_second / rate * 24 * price,
    )


def pays_from(machines: int, cores: int, measured: Mapping[str, Any]) -> float:
    """Frames from which so many machines with Ray are done before one of them is with the local engine; inf: never.

    n / r + s = n / (m q) + t: frames n, frames/s of a machine r and q, start s and t, locally and on Ray, m machines.
    """
    local, ray = measured["engines"]["local, 2 cores"], measured["engines"]["ray, 2 workers"]
    saved = 2 / (cores * local["frames/s"]) - 2 / (machines * cores * ray["frames/s"])
    return (ray["start and end, s"] - local["start and end, s"]) / saved if saved > 0 else math.inf


def cost_lines(measured: Mapping[str, Any], price: float) -> list[str]:
    """What days of frames need, and when Ray pays, as Markdown."""
    lines = [
        f"| frames of {measured['megapixels']} MP a day | cores | memory, GB | from the store, MB/s | pictures/s "
        f"| rows, GB a day | a day costs, at {price:g} a core-hour |",
        "|---|---|---|---|---|---|---|",
    ]
    for power, name in ((6, "a million"), (7, "ten million"), (8, "a hundred million"), (9, "a billion")):
        need = needs(10**power, measured, price)
        lines.append(
            f"| {name} | {need.cores} | {need.memory:.0f} | {need.bandwidth:.0f} | {need.pictures:.0f} | "
            f"{need.rows:.1f} | {need.price:.1f} |"
        )
    lines += ["", "| machines of 16 cores | on Ray quicker than one of them from | which takes |", "|---|---|---|"]
    for machines in (2, 4, 16):
        frames = pays_from(machines, 16, measured)
        seconds = frames / 8 / measured["engines"]["local, 2 cores"]["frames/s"]
        lines.append(f"| {machines} | {frames:.0f} frames | {seconds:.0f} s |")
    return lines


def costs(folder: Path, arguments: argparse.Namespace) -> None:
    """Prints what was measured and what follows, or writes it into a page, between the comments that say so."""
    measured = json.loads(arguments.figures.read_text())
    made = {"throughput": measured_lines(measured), "costs": cost_lines(measured, arguments.price)}
    if arguments.into is None:
        print("\n".join([*made["throughput"], "", *made["costs"]]))
        return
    text = arguments.into.read_text()
    for name, lines in made.items():
        begin, end = f"<!-- made by scripts/bench_scale.py: {name} -->\n", "<!-- end -->"
        head, _, rest = text.partition(begin)
        text = "".join([head, begin, "\n", "\n".join(lines), "\n\n", end, rest.partition(end)[2]])
    arguments.into.write_text(text)


def three_nodes() -> tuple[Any, list[Any]]:
    """A cluster on this machine, and two of its nodes; anew where one does not start within Ray's 30 s."""
    from ray.cluster_utils import Cluster

    for _ in range(5):
        cluster: Any = Cluster()
        try:
            cluster.add_node(num_cpus=1)
            return cluster, [cluster.add_node(num_cpus=1) for _ in range(2)]
        except Exception as error:  # Ray raises no other
            print(f"a node did not start: {error}", flush=True)
            cluster.shutdown()
    raise SystemExit("no cluster starts here")


def loss(folder: Path, arguments: argparse.Namespace) -> None:
    """Runs of which two of three nodes are killed, each at a random moment."""
    os.environ.setdefault("RAY_worker_niceness", "0")  # as of a cluster that starts with the command
    draw, count = random.Random(arguments.seed), arguments.frames or 400
    frames, whole = linked(folder / "frames", count), Counter[str]()
    for run in range(arguments.runs):
        cluster, nodes = three_nodes()
        out = folder / f"{run}.parquet"
        options = ["--engine", "ray", "--batch", "4", "--method", "centers"]
        task = subprocess.Popen(command(frames, out, *options, "--address", cluster.address))
        moments = sorted(draw.uniform(0, 0.9) for _ in nodes)  # share of the blocks that is done
        for node, moment in zip(nodes, moments, strict=True):
            while task.poll() is None and len(list(out.glob("part-*"))) < moment * count / 4:
                time.sleep(0.1)
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
            f"run {run}: killed at {', '.join(f'{m:.0%}' for m in moments)}, exit {code}: {dict(whole)}",
            flush=True,
        )


def store(folder: Path, arguments: argparse.Namespace) -> None:
    """Small frames from and to a store, by both engines; memory of the command with a tenth of them and with all."""
    import cv2

    from tests.io.stores import ENVIRONMENT, put, s3_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    count, picture = arguments.frames or 10000, cv2.imencode(".png", small_sample(folder))[1].tobytes()
    with s3_server("cell", every=0) as (url, application):
        os.environ.update(ENVIRONMENT | {"AWS_ENDPOINT_URL": url, "XDG_CACHE_HOME": str(folder)})
        for share in (10, 1):
            for number in range(count // share):
                put("cell", f"{share}/{number:06d}.png", picture)
        application._every = 50
        for engine in ("ray", "local"):
            for share in (10, 1):
                before = application.asked, application.failed
                out = Place(f"s3://cell/out/{engine}{share}.parquet")
                options = ["--engine", engine, "--threads", "2", "--batch", "64", "--method", "centers"]
                run = timed(command(f"s3://cell/{share}", str(out), *options, sample=folder))
                table = rows(fetched(out, folder / f"{engine}{share}.parquet"))
                found = Counter(row["frame"] for row in table)
                told = Counter(str(row["reason"] or row["status"]) for row in table)
                print(
                    f"{engine}, {count // share} frames: {run.seconds:.0f} s, "
                    f"{len(found)} of them have rows, {sum(found.values()) - len(found)} twice, {dict(told)}, "
                    f"{application.failed - before[1]} of {application.asked - before[0]} requests failed, "
                    f"command {run.mb} MB",
                    flush=True,
                )


def fetched(table: Place, copy: Path) -> Path:
    """A copy of a table, or of one in parts, here."""
    if table.kind() == "file":
        copy.write_bytes(table.read(1 << 30))
        return copy
    copy.mkdir()
    for one in table.listed():
        (copy / one.name).write_bytes((table / one.name).read(1 << 30))
    return copy


def small_sample(folder: Path) -> np.ndarray:
    """A small frame, with camera.yaml and target.yaml beside it."""
    import torch

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
