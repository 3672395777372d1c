"""The page in a real browser, on the twin: what it shows, that it changes with the scene, and on a phone's width.

Needs playwright (Python) and a Chromium, which Debian has as `chromium`; skips where one is missing. With
TORCHPOSE_SCREENSHOTS=DIR the pictures of the page are kept there.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.live.cell import Page, served
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.live.sources import camera_of_rig
from torchpose.rig.twin.scene import Scene

sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[browser]'")
pytest.importorskip("pypylon.pylon", reason="needs pypylon: pip install '.[rig]'")
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM, reason="needs a Chromium: apt-get install chromium"),
]

ROOT = Path(__file__).parents[2]
RIG, TWIN = ROOT / "configs/rig/ur5_2mp.yaml", ROOT / "configs/rig/twin_2mp.yaml"
LENS = ROOT / "configs/cameras/acA5472_8mm_third.yaml"


class World:
    """What happens to the target of the twin while the page looks on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.look: dict[str, Any] = {}
        self.shift_mm = 0.0
        self.covered = (0.0, 0.0)  # shares of the picture, from the left and from above
        frame = Scene.frame

        def changed(scene: Scene, name: str, tool: Any, number: int, bits: int) -> torch.Tensor:
            imaging = scene.file.imaging.model_copy(update=self.look)
            scene = replace(scene, file=scene.file.model_copy(update={"imaging": imaging}))
            tool = [tool[0] + self.shift_mm, *tool[1:]]
            image = frame(scene, name, tool, number, bits)
            left, above = self.covered
            image[: int(above * image.shape[0]), : int(left * image.shape[1])] = 90
            return image

        monkeypatch.setattr(Scene, "frame", changed)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


@pytest.fixture
def page(world: World, tmp_path: Path) -> Iterator[Page]:
    camera = Camera.load(LENS)
    frames = camera_of_rig(RIG, TWIN, (camera.width, camera.height), None)
    torch.set_num_threads(1)
    with served(frames, tmp_path / "kept", camera=camera, wanted_um=0.5) as found:
        found.until(lambda: found.live.snapshot.number > 1, 120)
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


def opened(browser: Any, page: Page, width: int = 1400, height: int = 900, scheme: str = "light") -> Any:
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    tab = context.new_page()
    tab.problems = []
    tab.asked = []
    tab.on("console", lambda message: message.type in ("error", "warning") and tab.problems.append(message.text))
    tab.on("pageerror", lambda error: tab.problems.append(str(error)))
    tab.on("request", lambda request: tab.asked.append(request.url))
    tab.goto(page.url)
    return tab


def shoot(tab: Any, name: str) -> None:
    folder = os.environ.get("TORCHPOSE_SCREENSHOTS")
    if folder:
        tab.screenshot(path=str(Path(folder) / f"{name}.png"), full_page=True)


def until(tab: Any, true: str, seconds: float = 30.0) -> None:
    """Until a JavaScript expression is true. Polled from outside: the page's policy lets nobody evaluate text in it."""
    end = time.monotonic() + seconds
    while not tab.evaluate(f"Boolean({true})"):
        assert time.monotonic() < end, f"{true}; shown: {tab.locator('#status').text_content()}"
        tab.wait_for_timeout(30)


WORD = "document.querySelector('#status-word').textContent"
HINT = "document.querySelector('#status-hint').textContent"


def turn(key: str) -> str:
    return f"document.querySelector('#turn [data-key={key}]')"


def test_picture_pose_and_status_within_two_seconds(browser: Any, page: Page) -> None:
    began = time.monotonic()
    tab = opened(browser, page)
    until(tab, f"document.querySelectorAll('#overlay .outer').length === 4 && {WORD} === 'ok'")
    until(tab, "document.querySelector('#picture').naturalWidth > 0")
    assert time.monotonic() - began < 2.0
    row = page.live.snapshot.sight.row  # type: ignore[union-attr]
    shown = tab.locator("#pose tr").nth(2).locator("td").all_text_contents()
    assert shown[0] == "Z"
    assert float(shown[1]) == pytest.approx(row["tz"], abs=0.01)
    assert [float(shown[k]) for k in (3, 5)] == pytest.approx([1e3 * row["sz"], 1e3 * row["nz"]], rel=0.2)
    assert tab.locator("#overlay .axis").count() == 3
    assert tab.locator("#overlay .inner").count() == 4
    levels = tab.eval_on_selector_all("#turn li", "lines => lines.map(line => line.dataset.level)")
    assert levels == ["good"] * 5
    shoot(tab, "ok")
    assert tab.problems == []
    assert all(url.startswith((page.url, f"blob:{page.url}")) for url in tab.asked)
    tab.context.close()


def test_overlay_lies_on_the_rings(browser: Any, page: Page) -> None:
    """Where the overlay has a ring the picture has an edge: dark inside of it, light outside."""
    tab = opened(browser, page)
    until(
        tab,
        "document.querySelectorAll('#overlay .outer').length === 4 && document.querySelector('#picture').naturalWidth",
    )
    grey = tab.evaluate(
        """() => {
        const image = document.querySelector('#picture'), canvas = document.createElement('canvas');
        canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
        const pen = canvas.getContext('2d'); pen.drawImage(image, 0, 0);
        const box = document.querySelector('#overlay').viewBox.baseVal, found = [];
        for (const ring of document.querySelectorAll('#overlay .outer')) {
          const [x, y, a] = ['cx', 'cy', 'rx'].map((name) => Number(ring.getAttribute(name)));
          for (const share of [0.9, 1.1]) for (let k = 0; k < 12; k++) {
            const u = x + share * a * Math.cos(k * Math.PI / 6), v = y + share * a * Math.sin(k * Math.PI / 6);
            const to = (w, low, wide, size) => Math.floor((w - low) / wide * size);
            const at = [to(u, box.x, box.width, canvas.width), to(v, box.y, box.height, canvas.height)];
            found.push([share, pen.getImageData(...at, 1, 1).data[0]]);
          }
        }
        return found; }"""
    )
    assert len(grey) == 4 * 2 * 12
    assert all(value < 90 for share, value in grey if share < 1)
    assert all(value > 150 for share, value in grey if share > 1)
    tab.context.close()


def test_it_changes_with_the_scene(browser: Any, page: Page, world: World) -> None:
    tab = opened(browser, page)
    until(tab, f"{WORD} === 'ok'")

    world.shift_mm = 400.0
    until(tab, f"{WORD} === 'no target' && {HINT}.includes('into view')")
    assert tab.locator("#overlay .outer").count() == 0
    assert tab.locator("#markers").text_content() == "0/4"
    shoot(tab, "gone")

    world.shift_mm, world.covered = 0.0, (0.5, 0.5)
    until(tab, f"{WORD} === 'ok' && {HINT}.includes('Marker 0 is not found')")
    assert tab.locator("#markers").text_content() == "3/4"
    world.covered = (0.5, 1.0)
    until(tab, f"{WORD} === 'too few markers'")
    shoot(tab, "covered")
    world.covered = (0.0, 0.0)
    until(tab, f"{WORD} === 'ok'")

    world.look = {"psf_sigma": 3.5}
    until(tab, f"{turn('focus')}.dataset.level === 'bad' && {turn('focus')}.textContent.includes('Turn the focus')")
    value = tab.evaluate(f"parseFloat({turn('focus')}.querySelector('.value').textContent)")
    assert value == pytest.approx(3.5, abs=0.3)
    shoot(tab, "blurred")

    world.look = {"light": 330.0}
    until(tab, f"{turn('exposure')}.dataset.level === 'bad' && {turn('exposure')}.textContent.includes('Over-exposed')")
    assert "shorten the exposure" in tab.locator("#status-hint").text_content()
    assert tab.get_attribute("#status", "data-level") == "fair"
    shoot(tab, "bright")

    world.look = {}
    until(
        tab,
        f"{WORD} === 'ok' && {turn('exposure')}.dataset.level === 'good' && {turn('focus')}.dataset.level === 'good'",
    )
    assert tab.problems == []
    shoot(tab, "back")
    tab.context.close()


def test_a_recording_made_on_the_page_is_estimated(browser: Any, page: Page, tmp_path: Path) -> None:
    tab = opened(browser, page)
    until(tab, f"{WORD} === 'ok'")
    tab.click("#record")
    until(tab, "/: [2-9] frames/.test(document.querySelector('#kept').textContent)")
    shoot(tab, "recording")
    tab.click("#record")
    until(tab, "document.querySelector('#kept').textContent.includes('frames kept')")
    tab.click("#still")
    until(tab, "document.querySelector('#kept').textContent.startsWith('still-')")
    (manifest,) = (tmp_path / "kept").glob("recording-*/manifest.jsonl")
    out = tmp_path / "poses.jsonl"
    with pytest.raises(SystemExit) as ended:
        main(["estimate", str(manifest), "--camera", str(LENS), "--target", "quad40", "--out", str(out), "-q"])
    assert ended.value.code == 0
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(rows) >= 2
    assert {row["status"] for row in rows} == {"ok"}
    assert len(list((tmp_path / "kept").glob("still-*.png"))) == 1
    assert tab.problems == []
    tab.context.close()


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (390, "dark"), (320, "light"), (768, "light")])
def test_a_phone_scrolls_in_one_direction(browser: Any, page: Page, world: World, width: int, scheme: str) -> None:
    tab = opened(browser, page, width, 844, scheme)
    until(tab, f"{WORD} === 'ok' && document.querySelector('#picture').naturalWidth > 0")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    shoot(tab, f"phone-{width}-{scheme}")
    world.shift_mm = 400.0
    until(tab, f"{WORD} === 'no target'")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    for name in ("#record", "#still", "[data-layer=blur]"):
        assert tab.locator(name).is_visible()
    tab.context.close()


def test_dark_and_light(browser: Any, page: Page) -> None:
    tab = opened(browser, page, scheme="dark")
    until(tab, f"{WORD} === 'ok'")
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = tab.evaluate(ground)
    time.sleep(2)
    shoot(tab, "dark")
    tab.click("#theme")
    assert tab.evaluate(ground) != dark
    tab.click("[data-layer=blur]")
    tab.click("[data-layer=axes]")
    until(tab, "document.querySelectorAll('#overlay .axis').length === 0")
    assert "px" in tab.locator("#overlay text").first.text_content()
    tab.context.close()
