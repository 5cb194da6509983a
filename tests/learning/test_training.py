"""Training a stereo network: the pairs are true, the loss falls, and the file gives what torch does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner

from sags_node.cli.main import main
from sags_node.config import OnnxConfig
from sags_node.errors import UsageError
from sags_node.learning import material, onnx_file, rendered, training
from sags_node.learning.example import Example
from sags_node.learning.faults import photographed
from sags_node.learning.made_up import make_up
from sags_node.learning.material import Material
from sags_node.learning.network import evened, fit
from sags_node.learning.training import Trainer, errors, to_batch
from sags_node.phantom.noise import fractal_noise
from sags_node.types import U8
from sags_node.vision.onnx_network import DepthNetwork

SMALL = (96, 64)  # px


def texture(seed: int) -> U8:
    paint = fractal_noise(np.random.default_rng(seed), (300, 400), 24, 3)
    return np.clip(128 + 40 * paint, 0, 255).astype(np.uint8)[..., None].repeat(3, -1)


def silent(done: int, of: int, what: str) -> None: ...


def unlike(example: Example) -> np.ndarray:
    """How much the left picture differs (gray levels) from where its disparity leads in the right one."""
    truth = example.seen_by_both()
    rows, columns = np.indices(truth.shape, np.float32)
    seen = cv2.remap(example.right, columns - truth, rows, cv2.INTER_LINEAR)
    off = np.abs(example.left.astype(np.float32) - seen).mean(-1)
    return np.asarray(off[truth > 0])


@pytest.fixture
def small_material(monkeypatch: pytest.MonkeyPatch) -> Material:
    monkeypatch.setattr(training, "SIZE", SMALL)
    monkeypatch.setattr(training, "BATCH", 2)
    whole = make_up(np.random.default_rng(5), [texture(5)], rendered.SIZE)
    return Material([whole], [texture(6)])


# ---- pairs -----------------------------------------------------------------------------------------------


def test_painted_surfaces_lie_where_the_truth_says() -> None:
    for seed in range(4):
        example = make_up(np.random.default_rng(seed), [texture(seed)], (224, 160))
        off = unlike(example)
        assert np.median(off) < 2  # of a contrast of 40: what interpolating takes
        assert off.size > 0.4 * example.disparity.size
        moved = example._replace(disparity=example.disparity + 3)
        assert np.median(unlike(moved)) > 3 * np.median(off)


def test_a_part_of_a_pair_keeps_its_truth() -> None:
    whole = make_up(np.random.default_rng(1), [texture(1)], rendered.SIZE)
    for seed in range(4):
        part = rendered.crop(np.random.default_rng(seed), whole, (224, 160))
        assert part.left.shape == part.right.shape == (160, 224, 3)
        assert np.median(unlike(part)) < 3


def test_rendered_pairs_match(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendered, "SIZE", (192, 160))
    monkeypatch.setattr(rendered, "FRAMES", 1)
    (example,) = rendered.render(np.random.default_rng(0), 1, silent)
    assert (example.disparity > 0).mean() > 0.8
    moved = example._replace(disparity=np.where(example.disparity > 0, example.disparity + 2, 0))
    assert unlike(example).mean() < 0.6 * unlike(moved).mean()


def test_faults_change_pictures_and_not_the_truth() -> None:
    clean = make_up(np.random.default_rng(2), [texture(2)], SMALL)
    first, again, other = (photographed(np.random.default_rng(seed), clean) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.disparity, clean.disparity)
    np.testing.assert_array_equal(first.left, again.left)
    assert (first.left != other.left).mean() > 0.5


# ---- the network -----------------------------------------------------------------------------------------


def test_steps_on_the_pictures_find_parts_of_a_pixel() -> None:
    """Whatever is not yet learnt: from a guess that is off by 0.7 px."""
    wide = cv2.resize(texture(3), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    left, right = (
        cv2.resize(wide[:256, 40 + by : 40 + by + 384], (96, 64), interpolation=cv2.INTER_AREA)
        for by in (0, 3)
    )
    batch = to_batch([Example(left, right, np.zeros((64, 96), np.float32))])
    sure, guess = torch.ones(1, 1, 64, 96), torch.full((1, 1, 64, 96), 1.45)
    found = fit(evened(batch.left), evened(batch.right), guess, sure, 0.01 * sure, 0.2 * sure)
    assert np.median(np.abs(found[-1][0, 0, 8:-8, 8:-8].numpy() - 0.75)) < 0.05


def test_brightness_and_contrast_do_not_matter() -> None:
    picture = torch.from_numpy(texture(0) / np.float32(255)).permute(2, 0, 1)[None]
    shade = torch.linspace(0.6, 1.0, picture.shape[3])  # ever brighter to the right
    assert (evened(picture) - evened(0.1 + shade * picture)).abs().mean() < 0.05 * evened(
        picture
    ).abs().mean()


# ---- training --------------------------------------------------------------------------------------------


def test_training_makes_errors_small(small_material: Material, monkeypatch: pytest.MonkeyPatch) -> None:
    """On pairs that are not trained on: far from good, but better than before."""
    monkeypatch.setattr(training, "WARM_UP", 5)
    trainer = Trainer(small_material, 25)
    before, _ = errors(trainer.network, small_material, 6)
    trainer.train(silent)
    after, _ = errors(trainer.network, small_material, 6)
    assert after < 0.85 * before


def test_training_goes_on_where_it_stood(
    small_material: Material, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Trainer(small_material, 4)
    whole.train(silent)

    def until_half(done: int, of: int, what: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "SAVE_EVERY", 1)
    first = Trainer(small_material, 4)
    with pytest.raises(KeyboardInterrupt):
        first.train(until_half, tmp_path / "state.pt")
    second = Trainer(small_material, 4)
    second.resume(tmp_path / "state.pt")
    assert second.step == 2
    second.train(silent)
    for one, other in zip(whole.network.parameters(), second.network.parameters(), strict=True):
        torch.testing.assert_close(one, other)


def test_a_wrong_state_is_named(small_material: Material, tmp_path: Path) -> None:
    (tmp_path / "state.pt").write_bytes(b"no state")
    with pytest.raises(UsageError, match="remove it to begin anew"):
        Trainer(small_material, 4).resume(tmp_path / "state.pt")


# ---- the file --------------------------------------------------------------------------------------------


def test_from_training_to_the_node(
    small_material: Material, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command goes on where it was stopped. Its file gives torch's numbers, and says how it is read."""
    monkeypatch.setattr(material, "gather", lambda *_: small_material)
    file = tmp_path / "stereo.onnx"
    first = Trainer(small_material, 1)
    first.train(silent, file.with_suffix(".pt"))
    result = CliRunner().invoke(main, ["train", "depth", "--out", str(file), "--steps", "3"])
    assert result.exit_code == 0, result.output
    assert "goes on from step 1" in result.output
    assert file.stat().st_size < 1e6
    trainer = Trainer(small_material, 3)
    trainer.resume(file.with_suffix(".pt"))
    assert trainer.step == 3
    network = trainer.network.eval()
    assert onnx_file.difference(network, file) < 1e-3  # px: sums are taken in another order
    run = DepthNetwork(OnnxConfig(path=file, providers=("cpu",)), (640, 512), 2.5)
    assert run.is_stereo and run.way.map_name.output == "disparity"
    pair = small_material.rendered[0]
    given = run(pair.left, pair.right)
    small = [cv2.resize(eye, onnx_file.SIZE, interpolation=cv2.INTER_AREA) for eye in pair[:2]]
    batch = to_batch([Example(small[0], small[1], np.zeros(onnx_file.SIZE[::-1], np.float32))])
    with torch.no_grad():
        wanted = 2 * network(batch.left, batch.right)[0, 0].numpy()
    assert np.abs(given - cv2.resize(wanted, (640, 512))).mean() < 2e-3
