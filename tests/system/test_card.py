"""The card of the models: made of the files that it describes, and of figures that belong to their weights.

Expected behaviour: what the card says of ranges, data, cost and errors is what the files say; figures of other weights are refused; and the
card that ships is the one that the shipped models and figures give.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from deepclouds_runtime.card import describe, main, page
from deepclouds_runtime.multiply_adds import multiply_adds
from deepclouds_runtime.predictor import MODELS, RELEASED, Predictor

from benchmarks import accuracy_card
from benchmarks.accuracy_figures import Figure, Row
from deepclouds.errors import InputError


@pytest.fixture
def figures(tmp_path: Path) -> Path:
    """Figures of the default model, as the benchmark writes them."""
    rows = [
        Row("labels", "some labels, all", {"rRMSE": Figure(0.12, 0.11, 0.13)}),
        Row("confidence", "some labels, tenth 1 by expected error", {"expected": Figure(0.1, 0.1, 0.1), "found": Figure(0.2, 0.19, 0.21)}),
    ]
    path = tmp_path / "figures.json"
    accuracy_card.write_figures(path, Predictor(None), "python -m benchmarks.accuracy", "a machine", "accuracy: good", rows)
    return path


def test_the_card_says_what_the_file_says(figures: Path, tmp_path: Path) -> None:
    out = tmp_path / "card.md"
    assert main([RELEASED[0], "--figures", str(figures), "-o", str(out)]) == 0
    text, metadata = out.read_text(), Predictor(None).metadata
    for said in (
        metadata.initialisers_sha256[:16],
        metadata.config_hash[:16],
        metadata.dataset_hash[:16],
        f"{multiply_adds((MODELS / f'{RELEASED[0]}.onnx').read_bytes()):,}",
        f"| g1 | {metadata.ranges['g1'][0]:.3g} to {metadata.ranges['g1'][1]:.4g} |",
        "| some labels, all: rRMSE | 12.00 % [11.00, 13.00] |",
        "`python -m benchmarks.accuracy`, a machine",
        "accuracy: good",
    ):
        assert said in text, said
    for heading in ("What they are for", "Data", "Errors", "When not to trust them", "Known limits", "How to make them again", "Licence"):
        assert f"\n## {heading}\n" in text
    assert "NaN" not in text
    assert "None" not in text


def test_pictures_are_shown_where_there_are_any(figures: Path, tmp_path: Path) -> None:
    subject = describe(RELEASED[0], [figures])
    assert "## Pictures" not in page([subject], tmp_path)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / f"card_{RELEASED[0]}_special.png").touch()
    assert f"(images/card_{RELEASED[0]}_special.png)" in page([subject], tmp_path)


def test_figures_of_other_weights_are_refused(figures: Path, tmp_path: Path) -> None:
    content: dict[str, Any] = json.loads(figures.read_text())
    figures.write_text(json.dumps({**content, "weights": "f" * 64}))
    out = tmp_path / "card.md"
    with pytest.raises(InputError, match="belongs to the weights ffff"):
        main([RELEASED[0], "--figures", str(figures), "-o", str(out)])
    # Nor do those of another model stand in the way of the model's own.
    second = tmp_path / "own.json"
    second.write_text(json.dumps({**content, "weights": Predictor(RELEASED[1]).metadata.initialisers_sha256}))
    figures.write_text(json.dumps(content))
    for order in ((figures, second), (second, figures)):
        named = [word for path in order for word in ("--figures", str(path))]
        assert main([*RELEASED[:2], *named, "-o", str(out)]) == 0
        assert "| some labels, all: rRMSE | 12.00 % [11.00, 13.00] | 12.00 % [11.00, 13.00] |" in out.read_text()
    figures.write_text(json.dumps({**content, "weights": "f" * 64}))
    # Among the files of a folder they are simply not this model's.
    assert main([RELEASED[0], "--figures", str(tmp_path), "-o", str(out)]) == 0
    assert "Not measured" in out.read_text()
    figures.write_text("{}")
    with pytest.raises(InputError, match="not the figures of a model"):
        main([RELEASED[0], "--figures", str(figures), "-o", str(out)])
    with pytest.raises(InputError, match="does not exist"):
        main([RELEASED[0], "-o", str(tmp_path / "nowhere" / "card.md")])


def test_the_shipped_card_is_that_of_the_shipped_models(root: Path, tmp_path: Path) -> None:
    """Rationale: a model that is replaced without its card leaves a page that describes another. `make card` makes it anew."""
    shipped = (root / "docs" / "model_card.md").read_text()
    assert page([describe(name, [root / "docs" / "figures"]) for name in RELEASED], root / "docs") == shipped
    assert re.findall(r"--figures|deepclouds card (.*) --figures", (root / "Makefile").read_text())[0].split() == list(RELEASED)


def test_figures_and_pictures_are_kept_for_the_card(figures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy_card, "FOLDER", tmp_path / "figures")
    monkeypatch.setattr(accuracy_card, "IMAGES", tmp_path / "images")
    (tmp_path / "images").mkdir()
    pictures = [tmp_path / f"accuracy_{part}.png" for part in ("special", "scenes", "confidence")]
    for picture in pictures:
        picture.write_bytes(b"a picture")
    kept = accuracy_card.keep(figures, pictures, "small")
    assert sorted(p.name for p in kept) == ["card_small_confidence.png", "card_small_special.png", "small.json"]
    assert (tmp_path / "figures" / "small.json").read_text() == figures.read_text()


def test_a_command_names_no_machines_folders(tmp_path: Path) -> None:
    said = accuracy_card.as_typed(
        ["--scenes", "../elsewhere/scenes", "--labels", str(tmp_path / "labels"), "--labels", "work/valid", "--out", "x", "--card"]
    )
    assert said == "python -m benchmarks.accuracy --scenes scenes --labels labels --labels work/valid --card"
