"""Keep a run of `implicam paper all`: its numbers, its account, its pictures. `make paper` calls this.

    python docs/make_reproduce.py implicam-paper

Writes benchmarks/results/paper.json, docs/reproduce.md and the pictures that it shows, in 255 colours.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from PIL import Image

from implicam.experiments.account import markdown
from implicam.files import write_text

DOCS = Path(__file__).parent
PICTURES = "images/paper"


def main(folder: Path) -> None:
    text = (folder / "summary.json").read_text(encoding="utf-8")
    account = markdown(json.loads(text), figures=PICTURES)
    write_text(DOCS.parent / "benchmarks" / "results" / "paper.json", text)
    write_text(DOCS / "reproduce.md", account)
    (DOCS / PICTURES).mkdir(parents=True, exist_ok=True)
    for picture in sorted((folder / "figures").glob("*.png")):
        if f"{PICTURES}/{picture.name}" in account:
            Image.open(picture).convert("RGB").quantize(255).save(DOCS / PICTURES / picture.name, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
