"""The report and the comparison, opened in a real browser."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli
from PIL import Image

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.errors import ArtifactError
from vorolight.stages.report import comparison, page

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",  # WebGL by software
    "--enable-unsafe-swiftshader",
]
browsing = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
HOSTILE = "<img src=x onerror=alert(1)></script><script>alert(2)</script>&\"'"


@dataclass
class Opened:
    """A page in the browser, and all that went wrong in it."""

    tab: Any
    faults: list[str] = field(default_factory=list)

    def picture(self, index: int = 0) -> np.ndarray:
        """The pixels of a panel, once the picture is drawn."""
        self.tab.evaluate(
            "() => new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))"
        )
        data = self.tab.locator("canvas.live").nth(index).screenshot()
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def ready(self) -> None:
        # Not a function to wait for: the page's policy lets no text be evaluated.
        self.tab.wait_for_selector(".viewer[data-state=ready]")

    def show(self, key: str) -> None:
        self.tab.evaluate(f"document.querySelector('input.surface[value={key}]').click()")
        self.ready()

    def colour(self, mode: str) -> None:
        self.tab.select_option(".mode", mode)
        self.ready()

    def keys(self) -> list[str]:
        script = "[...document.querySelectorAll('input.surface')].map(box => box.value)"
        return list(self.tab.evaluate(script))

    def narrow(self) -> bool:
        return bool(self.tab.evaluate("document.documentElement.scrollWidth <= innerWidth"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield found
        found.close()


@pytest.fixture
def load(browser: Any) -> Iterator[Callable[..., Opened]]:
    """Open a file with what is said of the browser; afterwards nothing may have gone wrong."""
    made: list[Any] = []
    opened: list[Opened] = []

    def call(path: Path, works: bool = True, before: str = "", **context: Any) -> Opened:
        settings = {"viewport": {"width": 900, "height": 700}, **context}
        made.append(browser.new_context(**settings))
        tab = made[-1].new_page()
        result = Opened(tab)
        opened.append(result)

        def heard(message: Any) -> None:
            # Reading the picture back is slow, as the software renderer says.
            if message.type in ("error", "warning") and "GL Driver Message" not in message.text:
                result.faults.append(message.text)

        def asked(request: Any) -> None:
            if not request.url.startswith(("file:", "data:", "blob:")):
                result.faults.append(request.url)

        tab.on("console", heard)
        tab.on("pageerror", lambda error: result.faults.append(str(error)))
        tab.on("dialog", lambda dialog: (result.faults.append(dialog.message), dialog.dismiss()))
        tab.on("request", asked)
        if before:
            tab.add_init_script(before)
        tab.goto(path.resolve().as_uri())
        if works:
            result.ready()
        return result

    yield call
    faults = [fault for result in opened for fault in result.faults]
    for context in made:
        context.close()
    assert faults == []


def part_of(run: Path, target: Path, *stages: str) -> Path:
    """A copy of a run with only some of its stages."""
    target.mkdir(parents=True)
    for path in run.iterdir():
        if path.is_file() and path.name.split(".")[0] in stages:
            shutil.copy(path, target)
    return target


def written(run: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The report of a run without the static pictures, which other tests see."""
    monkeypatch.setattr(page, "PICTURES", {})
    return page.write(RunFolder(run), {})


def changed(run: Path, stem: str, change: Callable[[dict[str, Any]], None]) -> None:
    path = run / f"{stem}.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    del manifest["checksum"]
    path.write_text(json.dumps(manifest))


@browsing
def test_the_view_shows_every_surface(heart_run: Path, load: Callable[..., Opened]) -> None:
    opened = load(heart_run / "report.html")
    keys = opened.keys()
    assert keys == ["voxels", "init", "trained", "sphere-train", "volume", "cut", "fabricate"]
    seen = []
    for key in keys:
        opened.show(key)
        seen.append(opened.picture())
        assert len(np.unique(seen[-1].reshape(-1, 3), axis=0)) > 50
    # The trained surface is certified: it is the one that is written and bounds the volume.
    apart = [
        seen[keys.index(key)] for key in ("voxels", "init", "sphere-train", "cut", "fabricate")
    ]
    assert all((a != b).any() for k, a in enumerate(apart) for b in apart[:k])
    assert opened.tab.evaluate("Number(document.querySelector('.viewer').dataset.milliseconds)") > 0
    # The inner cells of the cut are orange.
    cut = seen[keys.index("cut")]
    assert (cut[..., 0] > cut[..., 2] + 60).mean() > 0.005


@browsing
def test_the_view_turns_and_moves(heart_run: Path, load: Callable[..., Opened]) -> None:
    opened = load(heart_run / "report.html")
    start = opened.picture()
    box = opened.tab.locator("canvas.live").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    mouse = opened.tab.mouse

    def drag() -> None:
        mouse.move(x, y)
        mouse.down()
        mouse.move(x + 60, y + 30)
        mouse.up()

    def moved(action: Callable[[], Any]) -> np.ndarray:
        before = opened.picture()
        action()
        after = opened.picture()
        assert (before != after).any()
        return after

    turned = moved(drag)
    opened.tab.keyboard.down("Shift")
    shifted = moved(drag)
    opened.tab.keyboard.up("Shift")
    assert (turned != shifted).any()
    opened.tab.locator("canvas.live").focus()
    for key in ("ArrowLeft", "ArrowUp", "Shift+ArrowRight", "+", "w"):
        moved(lambda key=key: opened.tab.keyboard.press(key))  # type: ignore[misc]
    moved(lambda: mouse.wheel(0, 200))
    moved(lambda: opened.tab.locator(".closer").click())
    moved(lambda: opened.tab.locator(".edges").click())  # which w had switched off
    opened.tab.locator(".reset").click()
    mouse.move(0, 0)
    opened.tab.evaluate("document.activeElement.blur()")
    assert np.array_equal(opened.picture(), start)


@browsing
def test_fingers_turn_and_zoom(heart_run: Path, load: Callable[..., Opened]) -> None:
    opened = load(heart_run / "report.html", has_touch=True)
    start = opened.picture()  # which scrolls to it
    box = opened.tab.locator("canvas.live").bounding_box()
    session = opened.tab.context.new_cdp_session(opened.tab)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def touch(*rounds: list[tuple[float, float]]) -> None:
        for k, points in enumerate(rounds):
            kind = "touchStart" if k == 0 else "touchMove"
            places = [{"x": a, "y": b, "id": i} for i, (a, b) in enumerate(points)]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    touch([(x, y)], [(x + 20, y)], [(x + 50, y)])
    turned = opened.picture()
    touch([(x - 30, y), (x + 30, y)], [(x - 60, y), (x + 60, y)], [(x - 90, y), (x + 90, y)])
    larger = opened.picture()
    background = start[2, 200]
    cover = [(np.abs(image - background).sum(axis=2) > 60).mean() for image in (turned, larger)]
    assert (start != turned).any()
    assert cover[1] > 1.5 * cover[0]


@browsing
def test_colours_have_a_legend_or_a_reason(heart_run: Path, load: Callable[..., Opened]) -> None:
    opened = load(heart_run / "report.html")
    plain = opened.picture()
    for mode in ("error", "curvature", "residual", "size"):
        opened.colour(mode)
        assert (opened.picture() != plain).mean() > 0.05
        assert opened.tab.locator(".legend .scale span").count() == 5
        assert opened.tab.locator(".note").inner_text() == ""
    opened.show("init")
    opened.colour("error")
    assert "vorolight evaluate --of init" in opened.tab.locator(".note").inner_text()
    assert not opened.tab.locator(".legend").is_visible()
    opened.colour("residual")
    assert "sphere-train" in opened.tab.locator(".note").inner_text()
    opened.show("sphere-train")
    opened.colour("size")
    before = opened.picture()
    opened.tab.locator(".shared").click()
    opened.ready()
    assert (opened.picture() != before).any()


@browsing
def test_dark_phone_and_print(heart_run: Path, load: Callable[..., Opened]) -> None:
    path = heart_run / "report.html"
    dark = load(path, color_scheme="dark")
    ink = "getComputedStyle(document.body).color"
    shade = "getComputedStyle(document.body).backgroundColor"
    assert dark.tab.evaluate(shade) != load(path).tab.evaluate(shade)
    for width in (360, 390):
        phone = load(path, viewport={"width": width, "height": 780}, device_scale_factor=2)
        assert phone.narrow()
        phone.tab.evaluate("for (const d of document.querySelectorAll('details')) d.open = true")
        assert phone.narrow()
    dark.tab.emulate_media(media="print")
    assert not dark.tab.locator(".controls").is_visible()
    assert not dark.tab.locator("canvas.live").is_visible()
    printed = dark.tab.locator("canvas.printed")
    assert printed.is_visible()
    pixels = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    assert printed.evaluate(f"canvas => new Set({pixels}).size") > 50
    assert dark.tab.evaluate(ink) == "rgb(17, 17, 17)"
    assert dark.tab.pdf().startswith(b"%PDF")


@browsing
def test_without_scripts_or_graphics(heart_run: Path, load: Callable[..., Opened]) -> None:
    path = heart_run / "report.html"
    still = load(path, works=False, java_script_enabled=False)
    assert "needs JavaScript" in still.tab.locator("noscript").inner_text()
    assert still.tab.locator("img").first.is_visible()
    assert not still.tab.locator(".controls").is_visible()
    none = "HTMLCanvasElement.prototype.getContext = () => null;"
    blind = load(path, works=False, before=none)
    assert "no WebGL" in blind.tab.locator(".failure").inner_text()
    assert blind.tab.locator("img").first.is_visible()


@browsing
@pytest.mark.parametrize(
    ("stages", "first", "said"),
    [(("classify",), "voxels", "vorolight init"), (("classify", "init"), "init", "sphere-train")],
    ids=["classify", "init"],
)
def test_pages_of_unfinished_runs(
    stages: tuple[str, ...],
    first: str,
    said: str,
    heart_run: Path,
    tmp_path: Path,
    load: Callable[..., Opened],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = part_of(heart_run, tmp_path / "some.vorolight", *stages)
    opened = load(written(run, monkeypatch))
    assert opened.tab.locator("input.surface:checked").get_attribute("value") == first
    assert said in opened.tab.locator(".absent").inner_text()
    assert len(np.unique(opened.picture().reshape(-1, 3), axis=0)) > 50


@browsing
def test_names_are_text(
    heart_run: Path, tmp_path: Path, load: Callable[..., Opened], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = part_of(heart_run, tmp_path / "<b>run.vorolight", "classify", "init")

    def rename(manifest: dict[str, Any]) -> None:
        manifest["inputs"][0]["name"] = manifest["command"] = HOSTILE
        manifest["warnings"] = [HOSTILE]

    changed(run, "classify", rename)
    opened = load(written(run, monkeypatch))
    assert opened.tab.locator("h1").inner_text() == HOSTILE
    assert opened.tab.locator("img").count() == 0
    other = tmp_path / "compare.html"
    runs = comparison.opened([RunFolder(run), RunFolder(heart_run)], [{"init": HOSTILE}, {}])
    monkeypatch.setattr(comparison, "surfaces", lambda folder, size: None)
    comparison.write(runs, other)
    compared = load(other)
    assert compared.tab.locator("img").count() == 0


@browsing
def test_two_runs_turn_together(
    heart_run: Path, tmp_path: Path, cli: Cli, load: Callable[..., Opened]
) -> None:
    run = part_of(heart_run, tmp_path / "start.vorolight", "classify", "init")
    done = cli("compare", heart_run, run, "-o", "both.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    opened = load(tmp_path / "both.html")
    assert opened.tab.locator(".panel").count() == 2
    assert opened.tab.locator(".message").nth(1).inner_text() == "not run"
    assert opened.tab.locator("td", has_text="not run").count() > 5
    opened.show("init")

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        """Of pictures that may lie a part of a pixel apart."""
        return float(np.abs(a[20:-20, 20:-20] - b[20:-20, 20:-20]).mean())

    first, second = opened.picture(0), opened.picture(1)
    assert apart(first, second) < 1
    opened.tab.locator("canvas.live").first.focus()
    opened.tab.keyboard.press("ArrowLeft")
    opened.tab.evaluate("document.activeElement.blur()")
    turned = opened.picture(1)
    assert apart(turned, second) > 3
    assert apart(opened.picture(0), turned) < 1
    phone = load(tmp_path / "both.html", viewport={"width": 360, "height": 700})
    assert phone.narrow()


def test_other_shapes_are_said_to_be_other(heart_run: Path, tmp_path: Path, cli: Cli) -> None:
    run = part_of(heart_run, tmp_path / "other.vorolight", "classify")
    changed(run, "classify", lambda manifest: manifest["inputs"][0].update(name="sphere"))
    done = cli("compare", heart_run, run, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "different shapes (heart of heart, other of sphere)" in done.stderr
    text = (tmp_path / "compare.html").read_text()
    assert "of different shapes" in text
    assert ">best<" not in text


def test_the_same_files_make_the_same_page(
    heart_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = part_of(heart_run, tmp_path / "a.vorolight", "classify", "init", "sphere-train", "volume")
    path = written(run, monkeypatch)
    first = path.read_bytes()
    assert written(run, monkeypatch).read_bytes() == first
    (run / "sphere-train.h5").write_bytes((run / "sphere-train.h5").read_bytes()[:5000])
    with pytest.raises(ArtifactError, match=r"sphere-train\.h5: changed since"):
        written(run, monkeypatch)
    (run / "sphere-train.h5").unlink()
    with pytest.raises(ArtifactError, match=r"sphere-train\.h5: missing"):
        written(run, monkeypatch)
