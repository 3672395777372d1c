"""Plots as readers need them: quantities with units, legends that cover no data, whole bands, plain numbers."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import Any

import matplotlib
import pytest
import torch
from matplotlib.figure import Figure

from torchpose import design
from torchpose.camera import Camera
from torchpose.report.design import plot_precision
from torchpose.report.figures import PlainLog, finish, legend_below, subplots
from torchpose.report.html import report
from torchpose.studies import fig02_pnp, fig05_shapes, table01_orientation
from torchpose.studies.study import StudyResult, Table
from torchpose.target import Target

matplotlib.use("Agg")
COLUMN = re.compile(r"^[a-z0-9]+_[a-z0-9_]+$")  # a name of a column of a table, not of a quantity


def drawn(figure: Figure) -> Figure:
    finish(figure).savefig(io.BytesIO(), format="png", dpi=50)
    return figure


def texts(figure: Figure) -> list[str]:
    names = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    for panel in figure.axes:
        names += [panel.get_xlabel(), panel.get_ylabel(), panel.get_title()]
        if (legend := panel.get_legend()) is not None:
            names += [text.get_text() for text in legend.get_texts()]
    return names


def overlap(figure: Figure) -> bool:
    """Whether a legend of the figure lies over one of its panels."""
    boxes = [legend.get_window_extent() for legend in figure.legends]
    return any(box.overlaps(panel.get_window_extent()) for box in boxes for panel in figure.axes)


def test_numbers_of_logarithmic_axes_are_plain() -> None:
    figure, ((panel,),) = subplots(1, 1, (4, 3))
    panel.semilogy([0, 1], [0.03, 0.4])
    drawn(figure)
    labels = [label.get_text() for label in panel.get_yticklabels(which="both") if label.get_text()]
    assert "0.1" in labels
    assert all(math.isclose(float(label), float(label)) and "times" not in label for label in labels)
    assert PlainLog()(100.0) == "100"


def test_legend_lies_beside_the_data() -> None:
    figure, axes = subplots(1, 2, (8, 3))
    for panel in axes[0]:
        panel.plot([0, 1], [0, 1], label="one")
    legend_below(figure, axes[0], 3, {"bound": ":", "worst": "+"})
    drawn(figure)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "bound", "worst"]
    assert not overlap(figure)


def of_fig02() -> Figure:
    names = ["torchpose iterative", "cv2 EPNP"]
    keys = ("position_median_mm", "orientation_median_deg", "orientation_rms_deg")
    rows: list[dict[str, Any]] = [
        {"noise_px": noise, "method": name} | dict.fromkeys(keys, noise * (1 + 9 * k))
        for noise in (0.02, 0.5)
        for k, name in enumerate([*names, fig02_pnp.BY_POINTS, fig02_pnp.BY_LINES])
    ]
    return fig02_pnp.plot(rows, dict.fromkeys(names, 0.1))


def of_fig05() -> Figure:
    rows: list[dict[str, Any]] = [
        {"curve": name, "mark": "cross", "value": value, "rms_px": 0.01, "bound_px": 0.002, "lost": 0.0}
        for name in fig05_shapes.CURVES
        for value in (0.1, 0.2)
    ]
    return fig05_shapes.plot(rows)


def of_table01() -> Figure:
    keys = ("predicted_rms_deg", "rms_deg", "largest_deg", "worst_within_0.2px_deg")
    rows: list[dict[str, Any]] = [
        {"axis": axis, "distance_mm": z} | dict.fromkeys(keys, 0.01 * z)
        for axis in table01_orientation.PAPER_NOISE_DEG
        for z in (12.0, 30.0)
    ]
    return table01_orientation.plot(rows)


@pytest.mark.parametrize("make", [of_fig02, of_fig05, of_table01])
def test_studies_name_quantities_and_keep_legends_off_the_data(make: Any) -> None:
    figure = drawn(make())
    assert not [name for name in texts(figure) if COLUMN.match(name)]
    assert not overlap(figure)
    for panel in figure.axes:
        for line in panel.lines:  # nothing is cut off
            low, high = sorted(panel.get_ylim())
            values = torch.as_tensor(line.get_ydata(), dtype=torch.float64)
            if line.get_transform() == panel.transData and len(values) > 1 and make is of_fig02:
                assert bool(((values >= low) & (values <= high)).all())


def test_map_of_one_distance_shows_its_surroundings() -> None:
    camera, target = Camera.ideal(912, 608, 700.0), Target.load("quad40")
    volume = design.WorkingVolume((160.0, 160.0))
    found = design.precision_map(camera, target, volume, design.Imaging())
    assert len(found.distance) > 2
    assert float(found.distance[0]) < 160 < float(found.distance[-1])
    assert float(found.tilt[-1]) > 0.4
    # the middle of the map is what the volume itself promises
    at = design.predict_volume(camera, target, volume, design.Imaging()).worst
    middle = found.by_tilt[len(found.distance) // 2, 0]
    expected = torch.stack([at[:2].max(), at[2], at[3:].max()])
    torch.testing.assert_close(middle, expected, rtol=0.05, atol=0)
    figure = drawn(plot_precision(found, "quad40", volume))
    assert all(panel.collections for panel in figure.axes)  # filled maps, and their colour bars
    assert "stars" in figure.get_suptitle()


def test_a_range_is_shown_as_it_is() -> None:
    volume = design.WorkingVolume((150.0, 170.0), tilt=0.3)
    assert design.surroundings(volume) == volume


def test_tables_of_the_report_are_lists_on_a_phone(tmp_path: Path) -> None:
    rows = [{"method": "a method with a long name", "error_px": 0.01, "bound_px": None}]
    StudyResult(tables=[Table("errors", "Errors", rows)]).save(
        tmp_path, {"study": "s", "title": "S: t", "full": False, "seed": 0, "seconds": 1.0, "cpu_seconds": 1.0}
    )
    text = report([tmp_path], {}, {"torch": "2"})
    assert 'data-name="error px">0.01<' in text
    assert "td::before { content: attr(data-name)" in text
