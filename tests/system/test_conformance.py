"""The contract proven for other programs: our kernel, the C++ header and a model against the conformance vectors."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deepclouds_runtime import conformance, predictor
from deepclouds_runtime._conformance_vectors import make_vectors
from deepclouds_runtime.conformance import SUFFIX, VECTORS, Vectors, digests, read_outputs, read_vectors, write_vectors
from deepclouds_runtime.verify import compare_inputs, kernel_aux, kernel_stencils, main
from numpy.typing import NDArray

from deepclouds.backend import backend
from deepclouds.descriptor import Descriptor
from deepclouds.descriptor.reference import stencils
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import mean_extinction

RELEASED = sorted(p.stem for p in predictor.MODELS.glob("*.onnx"))


@pytest.fixture(scope="module")
def vectors() -> Vectors:
    return read_vectors()


def stencils_of(vectors: Vectors, unit: float = 1.0, side: float = 1.0, sun: float = 1.0, w: float = 1.0) -> NDArray[np.float32]:
    """The kernel's stencils with factors that no implementation should have."""
    parts = []
    for m in vectors.media:
        rows = vectors.queries[m.first : m.first + m.count]
        descriptor = Descriptor(Field(backend("llvm"), vectors.volume, m.scale), unit * m.unit, m.origin)
        sides = np.full(m.count, side, np.float32)
        parts.append(descriptor.stencils_numpy(rows[:, 0:3], w * rows[:, 3:6], sun * rows[:, 6:9], side=sides))
    return np.concatenate(parts)


def test_the_vectors_hold_what_they_promise(vectors: Vectors) -> None:
    """Rationale: queries that leave a rule of the contract unused would prove nothing about it."""
    volume, queries = vectors.volume, vectors.queries
    assert VECTORS.stat().st_size < 1.5e6
    assert queries.shape == (1000, 14)
    assert sum(m.count for m in vectors.media) == 1000
    assert np.array_equal(volume.density, volume.density.astype(np.float16))
    assert np.unique(np.round(volume.voxel_size, 6)).size == 3
    assert np.abs(volume.to_world[:3, :3]).min() > 0.01
    # The hard cut runs through the cloud on some face.
    assert max(volume.density[:, :, 0].max(), volume.density[0].max()) > 0.2
    raw = [sum(0.5 * 2.0**k * m.unit <= volume.voxel_size.min() for k in range(10)) for m in vectors.media]
    assert raw == [2, 0, 3]
    assert [m.default for m in vectors.media] == [True, True, False]
    gamma, albedo = vectors.aux[:, 0], queries[:, 12]
    assert gamma.min() < 0.01
    assert gamma.max() > 3.13
    assert (queries[:, 11] == 1).mean() > 0.3
    assert (queries[:, 11] < 1).mean() > 0.3
    assert (albedo == 1).any()
    assert queries[:, 13].max() > 10
    points = (queries[:, :3] - volume.to_world[:3, 3]) @ np.linalg.inv(volume.to_world[:3, :3]).T
    assert np.mean(np.any((points < 0) | (points > 1), axis=1)) > 0.1
    assert 0.5 < np.mean(volume.sample(queries[:, :3]) > 0) < 0.8
    assert np.abs(vectors.full).max() > 1
    for level in range(10):
        assert np.mean(vectors.full[:, level] > 0) > 0.01


def test_the_vectors_are_those_of_the_readable_twin(vectors: Vectors) -> None:
    """Rationale: the file must follow from the code that is there; the stored stencils are made anew, a few of each medium."""
    for m in vectors.media:
        mine = np.flatnonzero((vectors.full_rows >= m.first) & (vectors.full_rows < m.first + m.count))[:6]
        rows = vectors.queries[vectors.full_rows[mine]]
        unit, origin = (None, None) if m.default else (m.unit, m.origin)
        found = stencils(vectors.volume, m.scale, rows[:, 0:3], rows[:, 3:6], rows[:, 6:9], unit, origin)
        np.testing.assert_allclose(found, vectors.full[mine], atol=1e-6)
    np.testing.assert_allclose(digests(vectors.full), vectors.digests[vectors.full_rows], atol=1e-7)


def test_kernel_and_aux_agree_with_the_vectors(vectors: Vectors) -> None:
    types = backend("llvm")
    for one in compare_inputs(vectors, kernel_stencils(types, vectors), kernel_aux(types, vectors)[0]):
        assert one.passed, one


def elsewhere(vectors: Vectors, voxels: float) -> Vectors:
    """The same queries into the volume shifted along its own axes, as by a grid whose samples are taken for corners."""
    to_world = vectors.volume.to_world.copy()
    to_world[:3, 3] += voxels * (to_world[:3, :3] / np.array(vectors.volume.resolution)).sum(axis=1)
    return replace(vectors, volume=Volume(vectors.volume.density, to_world))


def without_the_cut(vectors: Vectors) -> Vectors:
    """The same with the outermost samples going on for eight voxels beyond the box."""
    volume, n = vectors.volume, 8
    to_world = volume.to_world.copy()
    voxel = to_world[:3, :3] / np.array(volume.resolution)
    to_world[:3, :3] = voxel * (np.array(volume.resolution) + 2 * n)
    to_world[:3, 3] -= n * voxel.sum(axis=1)
    return replace(vectors, volume=Volume(np.pad(volume.density, n, mode="edge"), to_world))


def without_the_unit(vectors: Vectors) -> NDArray[np.float32]:
    units = np.concatenate([np.full(m.count, m.unit, np.float32) for m in vectors.media])
    bare: NDArray[np.float32] = stencils_of(vectors) / units[:, None, None]
    return bare


MISTAKES: dict[str, Callable[[Vectors], NDArray[np.float32]]] = {
    "x mirrored": lambda v: stencils_of(v, side=-1.0),
    "omega_sun in the direction of the light": lambda v: stencils_of(v, sun=-1.0),
    "w toward the eye": lambda v: stencils_of(v, w=-1.0),
    "unit off by a per cent": lambda v: stencils_of(v, unit=1.01),
    "half a voxel": lambda v: stencils_of(elsewhere(v, 0.5)),
    "a hundredth of a voxel": lambda v: stencils_of(elsewhere(v, 0.01)),
    "not zero outside": lambda v: stencils_of(without_the_cut(v)),
    "extinction in place of extinction times unit": without_the_unit,
    "z fastest": lambda v: np.ascontiguousarray(np.swapaxes(stencils_of(v).reshape(-1, 10, 9, 25), 2, 3)).reshape(-1, 10, 225),
    "coarsest level first": lambda v: np.ascontiguousarray(stencils_of(v)[:, ::-1]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_usual_mistakes_exceed_the_tolerances_by_far(vectors: Vectors, mistake: str) -> None:
    """Rationale: vectors are worth what they find. Expected: stencils and digests each exceed their tolerance tenfold."""
    stencil, digest, _ = compare_inputs(vectors, MISTAKES[mistake](vectors), vectors.aux)
    assert stencil.largest > 10 * stencil.tolerance
    assert digest.largest > 10 * digest.tolerance


def test_an_arc_cosine_in_single_precision_fails(vectors: Vectors) -> None:
    w, sun = vectors.queries[:, 3:6], vectors.queries[:, 6:9]
    aux = vectors.aux.copy()
    aux[:, 0] = np.arccos(np.clip(np.sum(w * sun, axis=1, dtype=np.float32), -1, 1))
    found = compare_inputs(vectors, stencils_of(vectors), aux)[2]
    assert found.largest > 10 * found.tolerance


def test_vectors_survive_writing_and_damage_is_refused(vectors: Vectors, tmp_path: Path) -> None:
    copy = tmp_path / "copy.bin"
    write_vectors(copy, vectors)
    assert copy.read_bytes() == VECTORS.read_bytes()
    cut = tmp_path / "cut.bin"
    cut.write_bytes(copy.read_bytes()[:-4])
    with pytest.raises(InputError, match=r"cut\.bin"):
        read_vectors(cut)
    cut.write_bytes(b"something else" * 10)
    with pytest.raises(InputError, match="no conformance vectors"):
        read_vectors(cut)


@pytest.mark.slow
def test_the_vectors_can_be_made_anew(vectors: Vectors) -> None:
    """Expected: the same cloud and queries. Their stencils are made by the twin, which the tests above hold against the file."""
    again = make_vectors()
    assert np.array_equal(again.volume.density, vectors.volume.density)
    np.testing.assert_allclose(again.queries, vectors.queries, rtol=1e-6)
    np.testing.assert_allclose(again.digests, vectors.digests, atol=1e-6)


@pytest.mark.parametrize("model", RELEASED)
def test_every_released_model_verifies(model: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = main([model])
    lines = capsys.readouterr().out.splitlines()
    assert code == 0, lines
    assert [line.split()[0] for line in lines] == ["model", "vectors", "stencil", "digest", "aux", "tau", "j"]
    assert all(line.endswith(": ok") for line in lines[2:])


@pytest.fixture
def copy_of_a_model(tmp_path: Path) -> Path:
    """A released model under another name, without its outputs."""
    target = tmp_path / "mine.onnx"
    shutil.copy(predictor.find_model(None), target)
    return target


def test_a_copy_is_known_by_its_weights(copy_of_a_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(copy_of_a_model)]) == 0
    assert "j        1000 outputs" in capsys.readouterr().out


def test_a_model_without_outputs_has_its_stencils_verified(
    copy_of_a_model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(predictor, "MODELS", copy_of_a_model.parent)
    assert main([str(copy_of_a_model)]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert "not compared: no outputs are stored for these weights" in last


def test_other_outputs_fail_and_other_weights_are_refused(copy_of_a_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert conformance.main([str(copy_of_a_model)]) == 0
    beside = copy_of_a_model.with_suffix(SUFFIX)
    # To the bit those of another copy; those that come along were written on another processor, whose matrix products may round otherwise.
    again = copy_of_a_model.with_name("again.onnx")
    shutil.copy(copy_of_a_model, again)
    assert conformance.main([str(again)]) == 0
    assert np.array_equal(read_outputs(beside).j, read_outputs(again.with_suffix(SUFFIX)).j)
    np.testing.assert_allclose(read_outputs(beside).j, read_outputs(predictor.find_model(None).with_suffix(SUFFIX)).j, rtol=1e-5)
    lines = beside.read_text().splitlines()
    changed = [*lines[:-1], str(1.001 * float(lines[-1]))]
    beside.write_text("\n".join(changed) + "\n")
    assert main([str(copy_of_a_model)]) == 1
    assert capsys.readouterr().out.splitlines()[-1].endswith("FAILED")
    beside.write_text("\n".join(line.replace("initialisers_sha256 ", "initialisers_sha256 0") for line in lines) + "\n")
    with pytest.raises(InputError, match="other weights"):
        main([str(copy_of_a_model)])
    beside.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(InputError, match="not a whole file"):
        main([str(copy_of_a_model)])


def test_other_vectors_are_refused(copy_of_a_model: Path, vectors: Vectors, tmp_path: Path) -> None:
    """Rationale: outputs for other queries would fail without saying why."""
    other = tmp_path / "other.bin"
    write_vectors(other, replace(vectors, queries=vectors.queries[::-1]))
    with pytest.raises(InputError, match="other vectors"):
        main([str(copy_of_a_model), "--vectors", str(other)])


def compiled(root: Path, source: Path, program: Path, *flags: str) -> Path:
    """A program that includes the header, compiled without a warning."""
    warnings = ["-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror"]
    command = ["g++", "-std=c++17", *flags, *warnings, f"-I{root / 'runtime' / 'cpp'}", str(source), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def cpp(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The C++ example."""
    return compiled(root, root / "runtime" / "cpp" / "verify.cpp", tmp_path_factory.mktemp("cpp") / "verify", "-O2")


def run(program: Path, file: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(program), str(file)], capture_output=True, text=True, check=False, timeout=120)


def test_the_cpp_header_agrees_with_the_vectors(cpp: Path) -> None:
    done = run(cpp, VECTORS)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()[1:]
    assert [line.split()[0] for line in lines] == ["stencil", "digest", "aux", "tau"]
    # Double precision: a hundredth of what single precision is allowed.
    assert all(float(line.split()[3].rstrip(",")) < 0.01 * float(line.split()[5].rstrip(":")) for line in lines[:3]), lines


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("stencil", lambda v: replace(v, full=v.full + np.float32(1e-3) * (np.arange(225) == 7))),
        ("digest", lambda v: replace(v, digests=v.digests + np.float32(1e-4))),
        ("aux", lambda v: replace(v, aux=v.aux + np.float32(1e-5))),
        ("tau", lambda v: replace(v, queries=v.queries * np.where(np.arange(14) == 13, 1.2, 1).astype(np.float32))),
    ],
)
def test_the_cpp_program_finds_a_difference(
    cpp: Path, vectors: Vectors, tmp_path: Path, name: str, changed: Callable[[Vectors], Vectors]
) -> None:
    other = tmp_path / "other.bin"
    write_vectors(other, changed(vectors))
    done = run(cpp, other)
    assert done.returncode == 1
    assert name in [line.split()[0] for line in done.stdout.splitlines() if line.endswith("FAILED")]


def test_the_program_of_the_documentation_compiles_and_runs(root: Path, tmp_path: Path) -> None:
    """Expected: the numbers that NumPy finds for the same ball."""
    text = (root / "docs" / "renderer_authors.md").read_text()
    source = tmp_path / "example.cpp"
    source.write_text(text.partition("```cpp\n")[2].partition("```")[0])
    program = compiled(root, source, tmp_path / "example", "-O1")
    line = subprocess.run([str(program)], capture_output=True, text=True, check=True, timeout=60).stdout
    unit, raw, value, tau = (float(found) for found in re.findall(r"-?\d+\.?\d*", line))

    centres = (np.arange(32) + 0.5) / 32 * 2 - 1
    z, y, x = np.meshgrid(centres, centres, centres, indexing="ij")
    ball = Volume.from_box(np.maximum(0, 1 - np.sqrt(x**2 + y**2 + z**2)), (-1, -1, -1), (1, 1, 1))
    mean_free_path = 1 / (20 * mean_extinction(ball))
    assert unit == pytest.approx(mean_free_path, abs=1e-4)
    assert raw == sum(0.5 * 2**k * mean_free_path <= 2 / 32 for k in range(10))
    point, sun = np.array([0.1, 0.2, 0.3]), np.array([0.6, 0, 0.8])
    expected = stencils(ball, 20.0, point[None], [[0, 0, -1]], sun[None])[0, 0, 2 * 25 + 2 * 5 + 2]
    assert value == pytest.approx(expected, abs=1e-4)
    steps = (np.arange(3000) + 0.5) / 1000
    assert tau == pytest.approx(20 * ball.sample(point + steps[:, None] * sun).sum() / 1000, rel=0.01)


def test_the_cpp_program_refuses_a_damaged_file(cpp: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.bin"
    cut.write_bytes(VECTORS.read_bytes()[:5000])
    assert run(cpp, cut).returncode == 2
    assert run(cpp, tmp_path / "absent.bin").returncode == 2


EDGES = r"""
#include "deepclouds.hpp"
#include <cstdio>
using namespace deepclouds;

double density(int i, int j, int k) { return 0.1 + 0.2 * i + 0.3 * j + 0.05 * k * k; }

template <class F>
void refuses(F make) {
  try {
    make();
    std::puts("accepted");
  } catch (const std::invalid_argument& error) {
    std::puts(error.what());
  }
}

int main() {
  const Box box{{-1, 0, 2}, {{{1, 0, 0}, {0, 3, 0}, {0, 0, 2}}}};
  const Grid grid{{1, 3, 4}, box, density};
  const Vec3 point{-0.6, 1.4, 3.1}, sun{0.48, 0.6, 0.64}, w{0, -0.6, 0.8};
  float s[stencil_size];
  const auto print = [&] {
    for (float v : s) std::printf("%.9g ", v);
    std::puts("");
  };
  const Descriptor cloud(grid, 2.0);
  cloud.stencil(point, w, sun, s);
  print();
  cloud.stencil(point, w, sun, s, 0.0, true);
  print();
  cloud.stencil(point, -1.0 * sun, sun, s, 0.7);
  print();
  Descriptor(grid, 0.0).stencil(point, w, sun, s);
  print();
  std::printf("%.9g %.9g\n", cloud.sigma_t(point), cloud.sigma_t({5, 5, 5}));
  refuses([&] { Descriptor(Grid{{1, 3, 4}, box, [](int, int, int) { return -1.0; }}, 1.0); });
  refuses([&] { Descriptor(Grid{{1, 3, 4}, {{}, {{{1, 0, 0}, {1, 3, 0}, {0, 0, 2}}}}, density}, 1.0); });
  refuses([&] { Descriptor(Grid{{1, 3, 4}, {{}, {{{1, 0, 0}, {0, 0, 0}, {0, 0, 2}}}}, density}, 1.0); });
  refuses([&] { Descriptor(Grid{{0, 3, 4}, box, density}, 1.0); });
  refuses([&] { Descriptor(grid, -1.0); });
  refuses([&] { Descriptor(grid, 1.0, 0.0, {}); });
}
"""


def test_the_cpp_header_at_its_edges(root: Path, tmp_path: Path) -> None:
    """What the vectors leave out: one sample along an axis, the mirror image, parallel view and light, no extinction, bad input."""
    source = tmp_path / "edges.cpp"
    source.write_text(EDGES)
    program = compiled(root, source, tmp_path / "edges", "-O1")
    lines = subprocess.run([str(program)], capture_output=True, text=True, check=True, timeout=60).stdout.splitlines()
    plain, mirrored, parallel, empty = (np.array(line.split(), float).reshape(10, 225) for line in lines[:4])

    k, j, i = np.meshgrid(np.arange(4), np.arange(3), np.arange(1), indexing="ij")
    volume = Volume.from_box(0.1 + 0.2 * i + 0.3 * j + 0.05 * k * k, (-1, 0, 2), (0, 3, 4))
    descriptor = Descriptor(Field(backend("llvm"), volume, 2.0))
    point, sun, w = np.array([[-0.6, 1.4, 3.1]]), np.array([[0.48, 0.6, 0.64]]), np.array([[0, -0.6, 0.8]])
    np.testing.assert_allclose(plain, descriptor.stencils_numpy(point, w, sun)[0], atol=1e-4)
    np.testing.assert_allclose(mirrored, descriptor.stencils_numpy(point, w, sun, side=[-1.0])[0], atol=1e-4)
    np.testing.assert_allclose(parallel, descriptor.stencils_numpy(point, -sun, sun, azimuth=[0.7])[0], atol=1e-4)
    assert np.abs(plain - mirrored).max() > 0.1
    assert not empty.any()
    inside, outside = map(float, lines[4].split())
    assert inside == pytest.approx(2 * volume.sample(point)[0], rel=1e-6)
    assert outside == 0
    words = ["not negative", "perpendicular", "no volume", "a sample along", "scale must be", "unit of length"]
    assert len(lines) == 5 + len(words)
    for line, expected in zip(lines[5:], words, strict=True):
        assert expected in line
