"""The network of masks: its loss in closed form, mirrors, a short training, and what the shipped one finds."""

import json
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from sq_perception.commands import main
from sq_perception.files import output_file
from sq_perception.imaging.segment_view import CHANNELS, MEASURED, OTHERS, PIXELS, SEGMENT
from sq_perception.learning import checkpoint, shard_training
from sq_perception.learning.network_config import MaskConfig
from sq_perception.learning.networks import MaskNetwork
from sq_perception.learning.training_config import MASK_RUN
from sq_perception.simulation.segment_views import NO, UNKNOWN, YES, SegmentViews, draw_segment_views

SMALL = MaskConfig(widths=(4, 8))


def shards(folder: Path, count: int, rng: np.random.Generator) -> None:
    """Shards of random views, in which a reading is the object's where the first channel is more than a half."""
    folder.mkdir()
    for k in range(count):
        images = rng.random((24, PIXELS, PIXELS, CHANNELS)).astype(np.float16)
        images[..., SEGMENT] = 1
        truth = np.where(images[..., 0] > 0.5, YES, NO).astype(np.uint8)
        save_file({"images": images, "truth": truth}, str(folder / f"{k:05d}.safetensors"))


def test_the_loss_is_a_weighted_cross_entropy() -> None:
    """Of a cell within the segment, one beside it and one without a reading; none where nothing was measured."""
    images = torch.zeros(1, CHANNELS, 1, 3)
    images[0, SEGMENT, 0, 0] = 1
    truth = torch.tensor([[[YES, NO, UNKNOWN]]])
    logits = torch.tensor([[[0.5, -1.0, 7.0]]])
    inside, beside = np.log1p(np.exp(-0.5)), np.log1p(np.exp(-1.0))
    expected = (inside + shard_training.AROUND * beside) / (1 + shard_training.AROUND)
    assert float(shard_training.mask_loss(logits, (images,), truth)) == pytest.approx(expected, rel=1e-6)
    assert float(shard_training.mask_loss(logits, (images,), torch.full_like(truth, UNKNOWN))) == 0


def test_a_hidden_label_takes_readings_and_tells_nothing_about_them(rng: np.random.Generator) -> None:
    """A square segment of one object; what is beyond a band may become another segment, and is the object's still."""
    shown, parted = set(range(CHANNELS)) - set(shard_training.HIDDEN), 0
    for _ in range(60):
        image, truth = np.ones((PIXELS, PIXELS, CHANNELS), np.float32), np.full((PIXELS, PIXELS), NO, np.uint8)
        image[..., [SEGMENT, OTHERS]] = 0
        image[20:44, 20:44, SEGMENT], truth[20:44, 20:44] = 1, YES
        shard_training.hide_label(image, truth, rng)
        gone = image[..., MEASURED] == 0
        assert 0 < np.count_nonzero(gone) < 24 * 24
        assert (image[gone][:, shard_training.HIDDEN] == 0).all()
        assert (truth == np.where(gone, UNKNOWN, np.where(truth == NO, NO, YES))).all()
        assert (image[..., sorted(shown)] == 1).all()
        both = image[..., SEGMENT] + image[..., OTHERS]
        assert (both[20:44, 20:44] == ~gone[20:44, 20:44]).all()
        parted += image[..., OTHERS].any()
    assert 5 < parted < 40


def test_a_training_learns_and_is_read_again(tmp_path: Path, rng: np.random.Generator) -> None:
    shards(tmp_path / "views", 3, rng)
    kind = replace(shard_training.MASKS, network=lambda _: MaskNetwork(SMALL))
    config = replace(MASK_RUN, minutes=0.1, batch=8, threads=1, held=1, validation=5)
    network = shard_training.train(kind, config, tmp_path / "views", tmp_path / "run")
    records = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert records[-1]["outliers"] == pytest.approx(1, abs=0.1)
    assert records[-1]["left"] < records[-1]["outliers"]
    assert checkpoint.load_masks(tmp_path / "run" / "masks.safetensors").config == SMALL == network.config


def test_of_a_set_larger_than_the_memory_some_shards_are_read_at_a_time(tmp_path, rng, monkeypatch) -> None:
    """Two of five, or one that is larger than all that may be held; others after each validation."""
    shards(tmp_path / "views", 6, rng)
    size, read = (tmp_path / "views" / "00000.safetensors").stat().st_size, []
    original = shard_training.read_views

    def read_views(none: SegmentViews, paths: list[Path]) -> SegmentViews:
        read.append([path.stem for path in paths])
        if len(read) == 16:
            raise ArithmeticError("enough")
        return original(none, paths)

    monkeypatch.setattr(shard_training, "read_views", read_views)
    kind = replace(shard_training.MASKS, network=lambda _: MaskNetwork(SMALL))
    config = replace(MASK_RUN, batch=2, threads=1, held=1, validation=1)
    for name, memory, expected in (("two", 2.5 * size, 2), ("one", 0.5 * size, 1)):
        read.clear()
        monkeypatch.setattr(shard_training, "_IN_MEMORY", memory)
        with pytest.raises(ArithmeticError, match="enough"):
            shard_training.train(kind, config, tmp_path / "views", tmp_path / name)
        held, *pools = read
        assert held == ["00000"]
        assert {len(pool) for pool in pools} == {expected}
        assert {shard for pool in pools for shard in pool} == {f"{k:05d}" for k in range(1, 6)}


def test_too_few_views_are_refused_and_a_shard_that_is_being_written_is_not_read(tmp_path, capsys, rng) -> None:
    tmp_path.joinpath("empty").mkdir()
    shards(tmp_path / "views", 2, rng)
    with output_file.writing(tmp_path / "views" / "00002.safetensors"):
        for folder, there in (("empty", 0), ("views", 2)):
            assert main.main(["train-masks", str(tmp_path / folder), "--output", str(tmp_path / "run")]) == 1
            assert f"expected more than 2 shards of views, found {there}" in capsys.readouterr().err


def test_a_damaged_shard_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], rng: np.random.Generator) -> None:
    """One that was cut short, and one of another network's views."""
    shards(tmp_path / "views", 3, rng)
    arguments = ["train-masks", str(tmp_path / "views"), "--output", str(tmp_path / "run")]
    whole = (tmp_path / "views" / "00001.safetensors").read_bytes()
    (tmp_path / "views" / "00001.safetensors").write_bytes(whole[:-10])
    assert main.main(arguments) == 1
    save_file({"images": np.zeros((1, 64, 64))}, str(tmp_path / "views" / "00001.safetensors"))
    assert main.main(arguments) == 1
    assert capsys.readouterr().err.count("00001.safetensors: not a readable shard of SegmentViews") == 2


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("images", np.zeros((24, PIXELS, PIXELS, CHANNELS - 1), np.float16)),
        ("images", np.zeros((24, PIXELS, PIXELS, CHANNELS), np.float64)),
        ("truth", np.zeros((23, PIXELS, PIXELS), np.uint8)),
        ("truth", np.zeros((), np.uint8)),
    ],
)
def test_a_shard_of_another_form_is_named(tmp_path, rng, name, wrong) -> None:
    shards(tmp_path / "views", 3, rng)
    path = tmp_path / "views" / "00001.safetensors"
    save_file({**load_file(str(path)), name: wrong}, str(path))
    with pytest.raises(ValueError, match=rf"00001\.safetensors: .*{name}: expected .* got {wrong.dtype}"):
        shard_training.read_views(shard_training.MASKS.none, sorted((tmp_path / "views").iterdir()))


@pytest.mark.parametrize("filled", [False, True])
def test_shards_without_a_view_are_named(tmp_path, capsys, rng, filled) -> None:
    """All of them, or those that are kept for validation."""
    shards(tmp_path / "views", 3, rng)
    for k in range(2 if filled else 3):
        save_file(vars(shard_training.MASKS.none), str(tmp_path / "views" / f"{k:05d}.safetensors"))
    assert main.main(["train-masks", str(tmp_path / "views"), "--output", str(tmp_path / "run")]) == 1
    assert "expected views in 00000.safetensors, 00001.safetensors, found none" in capsys.readouterr().err


def test_views_of_no_object_have_figures(rng: np.random.Generator) -> None:
    images = rng.random((2, PIXELS, PIXELS, CHANNELS)).astype(np.float16)
    views = SegmentViews(images, np.full((2, PIXELS, PIXELS), NO, np.uint8))
    found = shard_training.validate_masks(MaskNetwork(SMALL), views)
    assert found["outliers"] > 0 == found["lost"]


def test_a_shard_that_comes_before_those_held_is_trained_on(tmp_path: Path, rng: np.random.Generator) -> None:
    """Between two parts of a run one of a lower number appears: what the first part learnt is not validated on."""
    shards(tmp_path / "views", 3, rng)
    (tmp_path / "views" / "00000.safetensors").rename(tmp_path / "later")
    validated = []

    def validate(network: MaskNetwork, views: SegmentViews) -> dict[str, float]:
        validated.append(views.truth)
        return {}

    kind = replace(shard_training.MASKS, network=lambda _: MaskNetwork(SMALL), validate=validate)
    config = replace(MASK_RUN, minutes=0.001, batch=2, threads=1, held=1)
    shard_training.train(kind, config, tmp_path / "views", tmp_path / "run")
    (tmp_path / "later").rename(tmp_path / "views" / "00000.safetensors")
    shard_training.train(kind, config, tmp_path / "views", tmp_path / "run")
    first, again = validated[0], validated[-1]
    np.testing.assert_array_equal(first, again)
    (tmp_path / "views" / "00001.safetensors").unlink()
    with pytest.raises(OSError, match=r"00001\.safetensors"):
        shard_training.train(kind, config, tmp_path / "views", tmp_path / "run")


def test_the_command_draws_what_the_training_reads(tmp_path: Path) -> None:
    assert main.main(["segment-views", str(tmp_path), "--shards", "1", "--scenes", "2"]) == 0
    drawn = shard_training.read_views(shard_training.MASKS.none, [tmp_path / "00000.safetensors"])
    again = draw_segment_views(2, np.random.default_rng([0, 0]))
    np.testing.assert_array_equal(drawn.images, again.images)
    np.testing.assert_array_equal(drawn.truth, again.truth)


@pytest.mark.parametrize("command", ["segment-views", "thing-views"])
def test_commands_draw_on_one_thread_as_a_process_a_core_may(command, monkeypatch, tmp_path) -> None:
    found: list[int] = []
    monkeypatch.setattr(shard_training, "write_views", lambda *_: found.append(numba.get_num_threads()))
    before = numba.get_num_threads()
    assert main.main([command, str(tmp_path)]) == 0
    assert found == [1]
    assert numba.get_num_threads() == before


def test_the_shipped_network_finds_outliers_in_scenes_that_it_has_not_seen() -> None:
    """More than half of them, for a fiftieth of the objects' readings."""
    views = draw_segment_views(20, np.random.default_rng([77, 5]))
    found = shard_training.validate_masks(checkpoint.load_masks(), views)
    assert found["outliers"] > 0.03
    assert found["left"] < 0.5 * found["outliers"]
    assert found["lost"] < 0.03
