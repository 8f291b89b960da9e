"""Pages in a real browser. POPGEN_AXE names an axe.min.js (npm's axe-core) to look for serious findings with."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from support.finished import finished_run

from popgen.pages.report_source import read_source
from popgen.pages.run_report import report_page

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
PROBE = """
<script>addEventListener("load", () => setTimeout(async () => {
  const slider = document.querySelector("input[type=range]");
  slider.value = "7";
  slider.dispatchEvent(new Event("input"));
  const canvas = document.querySelector("canvas");
  const shown = new Set(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data).size;
  const found = window.axe ? (await axe.run()).violations.filter((one) => /serious|critical/.test(one.impact)) : [];
  const told = { caption: document.querySelector("figcaption").innerText, shown, last: slider.max,
    wide: document.documentElement.scrollWidth > innerWidth, found: found.map((one) => one.id) };
  document.body.append(Object.assign(document.createElement("pre"), { id: "told", textContent: JSON.stringify(told) }));
}, 300));</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize("width", [1280, 500])
def test_a_report_plays_its_replays_and_fits(width: int, tmp_path: Path) -> None:
    run = finished_run(
        tmp_path, "run", [{"SP": 100}, {"SP": 50, "XP": 50}], curves={1: [(1, 1.0, None), (9, 2.0, None)]}
    )
    axe = f"<script>{Path(os.environ['POPGEN_AXE']).read_text()}</script>" if "POPGEN_AXE" in os.environ else ""
    page = tmp_path / "page.html"
    page.write_text(report_page(read_source(run)).replace("</body>", axe + PROBE))
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--window-size={width},900"]
    flags += ["--virtual-time-budget=20000", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]
    done = subprocess.run([str(BROWSER), *flags, page.as_uri()], capture_output=True, text=True, timeout=120)
    held = re.search(r'<pre id="told">(.*?)</pre>', done.stdout, re.DOTALL)
    assert held, done.stderr[-2000:]
    told = json.loads(html.unescape(held[1]))
    assert told["caption"].startswith("step 7 of 20") and told["last"] == "20" and told["shown"] > 5
    assert not told["wide"] and told["found"] == []
