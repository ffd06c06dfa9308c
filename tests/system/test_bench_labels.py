"""The benchmark of labels: its arithmetic, and that it runs.

Expected behaviour: correlated labels count for what they are worth, a cost is variance times time, both tracers label the same thing,
the last line has the agreed form, and the page is written between its marks only.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from deepclouds_training.mitsuba_tracer import draw_directions
from deepclouds_training.points import uniform_directions

from benchmarks import label_cost, labels
from benchmarks.label_cost import PHASES, TARGET, Cost, Task, effective_labels
from benchmarks.label_information import Labels, Worth, judge, train
from benchmarks.page import marks, write_results
from deepclouds.backend import backend
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.volume import Volume


def cost(seconds: float) -> Cost:
    return Cost(seconds=seconds, typical=seconds, paths_per_second=1000.0, load=0.1, effective=4.0)


def rows() -> list[labels.Row]:
    return [labels.Row(cloud, r, cost(1.0 + r), cost(20.0 * (1 + r) ** 2)) for r in range(3) for cloud in ("one", "two")]


def test_correlated_labels_are_worth_less() -> None:
    rng = np.random.default_rng(1)
    independent = rng.gamma(0.2, size=(200_000, 8))
    assert effective_labels(independent) == pytest.approx(8, rel=0.05)
    same = np.repeat(independent[:, :1], 8, axis=1)
    assert effective_labels(same) == pytest.approx(1)
    # Pairs of equal labels: four.
    assert effective_labels(np.repeat(independent[:, :4], 2, axis=1)) == pytest.approx(4, rel=0.05)
    # What never varies is no label; scale does not matter.
    assert effective_labels(np.concatenate([independent[:, :2] * [1, 50], np.zeros((200_000, 3))], axis=1)) == pytest.approx(2, rel=0.05)
    assert effective_labels(np.zeros((10, 3))) == 0


@pytest.mark.parametrize("phase", [-0.5, 0.0, 0.85, (0.8, -0.4, 0.75)])
def test_directions_follow_the_phase_function(phase: float | tuple[float, float, float]) -> None:
    """Legendre moments of the angle to w are powers of g, for each lobe; the azimuth is even; each point's directions lie around its w."""
    rng = np.random.default_rng(2)
    w = rng.normal(size=(3, 3))
    w = (w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32)
    d = draw_directions(rng, w, phase, 200_000)
    np.testing.assert_allclose(np.linalg.norm(d, axis=2), 1, atol=1e-6)
    cosine = np.einsum("nwc,nc->nw", d, w.astype(np.float64))
    g1, g2, weight = phase if isinstance(phase, tuple) else (phase, 0.0, 1.0)
    for order in (1, 2, 4):
        moment = weight * g1**order + (1 - weight) * g2**order
        values = np.polynomial.legendre.legval(cosine, np.eye(order + 1)[order])
        assert np.all(np.abs(values.mean(axis=1) - moment) < 4 * values.std(axis=1) / np.sqrt(d.shape[1]))
    across = d - cosine[..., None] * w[:, None]
    assert np.all(np.abs(across.mean(axis=1)) < 4 * across.std(axis=1) / np.sqrt(d.shape[1]) + 1e-6)


def test_a_cost_is_variance_times_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Walks of known variance and known duration: the worst label of a point sets its walks, dark labels are asked for less."""
    n, walks, seconds = 2, 40_000, 3.0
    means = np.ones((n, 4, 2))
    means[1] = 1e-4  # far below a tenth of the mean label
    deviation = np.full((n, 4, 2), 0.1)
    deviation[0, 2, 1] = 0.5

    def walk(*arguments: object) -> tuple[np.ndarray, float]:
        noise = np.random.default_rng(3).normal(size=(n, walks, 1, 1))
        return means[:, None] + deviation[:, None] * noise, seconds

    monkeypatch.setattr(label_cost, "walk", walk)
    group = (np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32))
    volume = Volume.from_box(np.ones((2, 2, 2)), (0, 0, 0), (1, 1, 1))
    task = Task(label_cost.CLOUDS[0], volume, 1.0, (group,) * len(PHASES), np.zeros((4, 3), np.float32), (means,) * len(PHASES))
    found = label_cost.our_cost(task, walks, 1)
    floor = 0.1 * means.mean()
    needed = (0.5 / TARGET) ** 2 + (0.1 / (TARGET * floor)) ** 2
    assert found.seconds == pytest.approx(len(PHASES) * needed * seconds / (n * walks), rel=0.03)
    typical = (7 * 0.1**2 + 0.5**2) / 8 / TARGET**2 + (0.1 / (TARGET * floor)) ** 2
    assert found.typical == pytest.approx(len(PHASES) * typical * seconds / (n * walks), rel=0.03)
    assert found.paths_per_second == pytest.approx(n * walks / seconds)
    assert found.effective == pytest.approx(1)


def test_the_last_line_is_the_median_over_repetitions() -> None:
    assert labels.headline(rows()) == "labels: 40 x cheaper than volpath (median of 3)"
    table = labels.markdown(rows(), {"ours": Worth(80, 1.0, 0.3, 0.01), "volpath": Worth(10, 1.1, 0.6, -0.02)})
    assert "| one | 2.0 | 80 | 40 [20, 60] | 40 | 4 | 20 |" in table
    assert "| volpath | 1.1 | 10 | 60.0% | -2.0% |" in table


def test_the_page_is_written_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "labels.md"
    page.write_text("before\n" + "\nold\n".join(marks("labels")) + "\nafter\n")
    for _ in range(2):
        write_results(page, "labels", "figures")
        assert page.read_text() == f"before\n{marks('labels')[0]}\n\nfigures\n\n{marks('labels')[1]}\nafter\n"
    page.write_text("\n".join((*marks("labels"), *marks("bench"))))
    write_results(page, "bench", "others")
    write_results(page, "labels", "figures")
    labels_first, end, bench_first = (*marks("labels"), marks("bench")[0])
    assert page.read_text() == f"{labels_first}\n\nfigures\n\n{end}\n{bench_first}\n\nothers\n\n{end}"
    page.write_text("no marks")
    with pytest.raises(InputError, match="once each"):
        write_results(page, "labels", "figures")


def test_a_quick_run(tmp_path: Path, capsys: pytest.CaptureFixture[str], scalar_mitsuba: object) -> None:
    assert labels.main(["--quick", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out.strip().splitlines()
    assert re.fullmatch(r"labels: [0-9.e+]+ x cheaper than volpath \(median of 1\)", printed[-1])
    with open(tmp_path / "labels.csv", newline="", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert {(r["cloud"], r["tracer"]) for r in found} == {(c.name, t) for c in label_cost.CLOUDS for t in ("ours", "volpath")}
    assert all(float(r["core_seconds"]) > 0 and float(r["paths_per_core_second"]) > 0 for r in found)
    assert all(1 <= float(r["effective_labels"]) <= 8 for r in found)
    assert (tmp_path / "labels.png").stat().st_size > 1000


class Exact(torch.nn.Module):
    """Predicts the rule of `ruled` from the aux row alone."""

    def forward(self, stencil: torch.Tensor, aux: torch.Tensor) -> torch.Tensor:
        return 1 + torch.cos(aux[:, 0])


def ruled(n: int, seed: int, noise: float) -> tuple[Labels, np.ndarray]:
    """Two independent noisy halves of labels that are 1 + cos(gamma)."""
    rng = np.random.default_rng(seed)
    field = Field(backend(), Volume.from_box(np.ones((4, 4, 4)), (0, 0, 0), (1, 1, 1)), 3.0)
    w, sun = (uniform_directions(rng, n) for _ in range(2))
    truth = 1 + np.sum(w.astype(np.float64) * sun, axis=1)
    half = truth * (1 + noise * rng.normal(size=(2, n)))
    one = np.ones(n, np.float32)
    return Labels(field, rng.random((n, 3)).astype(np.float32), w, 0 * one, sun, one, half[0], 1.0), half[1]


def test_the_judge_is_free_of_the_labels_noise() -> None:
    """A perfect network has no error although each label is half noise; one that is 20 % too bright has 20 % and more."""
    valid = [ruled(4000, seed, noise=0.5) for seed in (1, 2)]
    rrmse, energy = judge(Exact(), valid)
    assert rrmse < 0.06
    assert abs(energy) < 0.03

    class Bright(Exact):
        def forward(self, stencil: torch.Tensor, aux: torch.Tensor) -> torch.Tensor:
            return 1.2 * super().forward(stencil, aux)

    rrmse, energy = judge(Bright(), valid)
    assert energy == pytest.approx(0.2, abs=0.03)
    # 20 % of the root mean square, which is sqrt(1 + 1/3) times the mean.
    assert rrmse == pytest.approx(0.2 * np.sqrt(4 / 3), abs=0.04)


def test_training_learns_from_noisy_labels() -> None:
    sets = [ruled(3000, seed, noise=1.0)[0] for seed in (3, 4)]
    valid = [ruled(1000, 5, noise=0.2)]
    untrained, _ = judge(train(sets, 1, seed=6, batch=256), valid)
    trained, energy = judge(train(sets, 60, seed=6, batch=256), valid)
    assert trained < 0.5 * untrained
    assert abs(energy) < 0.1
