"""Fixed sets: the same to the bit when made again, whole after a kill, true to their bodies; damage is found."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sq_perception.commands import main
from sq_perception.geometry import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.learning import fixed_set
from sq_perception.learning.dataset import ViewSource, draw_views, move_bodies, move_images
from sq_perception.learning.fixed_set import FixedSet, FixedSetError, Settings, ShuffledBatches, draw, generate
from sq_perception.simulation import view_rendering

VIEWS = Settings("cropped", 24, train=50, test=7, seed=5)
FULL = Settings("full", 48, train=20, test=5, seed=5)


@pytest.fixture(scope="module", autouse=True)
def _small_shards() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fixed_set, "SHARD", 16)
        yield


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("views")
    generate(folder, VIEWS)
    return folder


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full")
    generate(folder, FULL)
    return folder


@pytest.fixture
def own(views: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return Path(shutil.copytree(views, tmp_path / "own"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def rendered(body: Superquadric, settings: Settings) -> np.ndarray:
    """The grey image of a body of the cube frame."""
    depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera(settings.pixels))
    return unit_cube.grey_from_depth(depth, settings.dtype)


class TestGeneration:
    @pytest.mark.parametrize("settings", [VIEWS, FULL])
    def test_made_again_it_is_the_same_to_the_bit(
        self, settings: Settings, views: Path, full: Path, tmp_path: Path
    ) -> None:
        generate(tmp_path, settings)
        assert contents(tmp_path) == contents(views if settings is VIEWS else full)

    def test_a_shard_does_not_depend_on_the_others(self) -> None:
        alone = draw(VIEWS, "train", 2, 16)
        longer = draw(replace(VIEWS, train=500, test=0), "train", 2, 16)
        for mine, theirs in zip(alone, longer, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        others = [draw(VIEWS, "train", 1, 16), draw(VIEWS, "test", 0, 7)]
        assert not any(np.isin(other[1][:, 0], alone[1][:, 0]).any() for other in others)

    def test_after_a_kill_it_goes_on_to_the_same_set(
        self, views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = tmp_path / "killed"

        def dies(path: Path, content: bytes) -> None:
            if path.name == "train-00002.safetensors":
                raise KeyboardInterrupt
            write(path, content)

        write = fixed_set.output_file.write
        monkeypatch.setattr(fixed_set.output_file, "write", dies)
        with pytest.raises(KeyboardInterrupt):
            generate(folder, VIEWS)
        with pytest.raises(FixedSetError, match="not finished"):
            FixedSet(folder, "train")
        monkeypatch.setattr(fixed_set.output_file, "write", write)
        before = (folder / "train-00000.safetensors").stat().st_mtime_ns
        generate(folder, VIEWS)
        assert (folder / "train-00000.safetensors").stat().st_mtime_ns == before
        assert contents(folder) == contents(views)

    def test_lost_cut_and_altered_shards_are_made_again(self, own: Path, views: Path) -> None:
        (own / "train-00000.safetensors").unlink()
        cut, altered = own / "train-00001.safetensors", own / "test-00000.safetensors"
        cut.write_bytes(cut.read_bytes()[:700])
        altered.write_bytes(altered.read_bytes()[:-1] + b"?")
        generate(own, VIEWS)
        assert contents(own) == contents(views)

    def test_another_set_is_never_overwritten(self, own: Path) -> None:
        before = contents(own)
        with pytest.raises(FixedSetError, match="other settings"):
            generate(own, replace(VIEWS, seed=6))
        assert contents(own) == before
        (own / "manifest.json").unlink()
        with pytest.raises(FixedSetError, match="choose another folder"):
            generate(own, VIEWS)

    @pytest.mark.parametrize(
        "wrong", [{"pixels": 1}, {"train": -1}, {"test": True}, {"framing": "view"}, {"seed": 1.5}]
    )
    def test_misuse_is_named(self, wrong: dict[str, Any]) -> None:
        with pytest.raises(ValueError, match=f"^{next(iter(wrong))}:"):
            replace(VIEWS, **wrong)


class TestReading:
    def test_full_frames_are_the_images_of_their_bodies(self, full: Path) -> None:
        images, bodies = FixedSet(full, "train").batch(range(20))
        grey = np.stack([rendered(body, FULL) for body in bodies])
        expected = np.where(grey > 0, (grey + np.float32(0.5)) / np.float32(255), 0)
        np.testing.assert_array_equal(images, expected.astype(np.float32))
        depth = np.stack([unit_cube.depth_from_grey(each) for each in grey])
        np.testing.assert_allclose(1 - images[images > 0], depth[grey > 0], atol=1e-6)
        assert (grey > 0).any(axis=(1, 2)).all()

    def test_views_are_what_is_drawn_directly(self, views: Path) -> None:
        images, bodies = FixedSet(views, "train").batch(np.arange(32, 48))
        drawn, seen = draw_views(16, np.random.default_rng([5, 0, 2]), ViewSource(24))
        np.testing.assert_allclose(images, drawn, atol=0.51 / 65535)
        np.testing.assert_array_equal(images > 0, drawn > 0)
        np.testing.assert_allclose(bodies.to_flat(), seen.to_flat(), atol=1e-6)
        again, _ = view_rendering.render_views(bodies, 24)
        assert np.abs(again - images).mean() < 0.01

    def test_any_order(self, views: Path) -> None:
        chosen = np.random.default_rng(0).integers(50, size=40)
        images, bodies = FixedSet(views, "train").batch(chosen)
        every, all_bodies = FixedSet(views, "train").batch(range(50))
        np.testing.assert_array_equal(images, every[chosen])
        np.testing.assert_array_equal(bodies.to_flat(), all_bodies.to_flat()[chosen])
        assert images.dtype == np.float32
        nothing, nobody = FixedSet(views, "test").batch([])
        assert nothing.shape == (0, 24, 24)
        assert len(nobody) == 0

    def test_indices_are_checked(self, views: Path) -> None:
        split = FixedSet(views, "test")
        assert len(split) == 7
        for wrong in ([7], [-1]):
            with pytest.raises(IndexError, match="0 to 6"):
                split.batch(wrong)
        with pytest.raises(ValueError, match="split"):
            FixedSet(views, "validation")

    def test_batches_show_everything_once_a_round(self, views: Path) -> None:
        batches = ShuffledBatches(FixedSet(views, "train"), np.random.default_rng(0))
        sizes = np.concatenate([batches.batch(25)[1].size.prod(axis=1) for _ in range(4)]).round(12)
        assert len(np.unique(sizes)) == 50
        assert len(np.unique(sizes[:50])) == 50
        assert (sizes[:50] != sizes[50:]).any()

    def test_batches_turn_images_with_their_bodies(self, views: Path) -> None:
        images, bodies = ShuffledBatches(FixedSet(views, "train"), np.random.default_rng(1)).batch(50)
        again, _ = view_rendering.render_views(bodies, 24)
        assert np.abs(again - images).mean() < 0.01
        stored, _ = FixedSet(views, "train").batch(range(50))
        moved = [not (image == stored).all(axis=(1, 2)).any() for image in images]
        assert sum(moved) > 30

    def test_dihedral_positions_hold_for_full_frames(self, full: Path) -> None:
        """Pixels at column / (n - 1) lie symmetrically about 1/2 too: a turned frame is that of the turned body."""
        images, bodies = FixedSet(full, "train").batch(range(16))
        turns, mirror = np.arange(16) % 4, np.arange(16) // 4 % 2 == 0
        turned, moved = move_images(images, turns, mirror), move_bodies(bodies, turns, mirror)
        again = FULL.values(np.stack([rendered(body, FULL) for body in moved]))
        assert (turned != again).mean() < 1e-4  # where z lies on a grey level, to the last digit
        assert (turned != images).mean() > 0.1


class TestDamage:
    @pytest.mark.parametrize("place", [3, 200, -5])
    def test_a_flipped_byte_is_found(self, own: Path, place: int) -> None:
        path = own / "train-00001.safetensors"
        content = bytearray(path.read_bytes())
        content[place] ^= 1
        path.write_bytes(content)
        split = FixedSet(own, "train")
        split.batch([0, 40])
        with pytest.raises(FixedSetError, match=r"train-00001.*: damaged, its checksum"):
            split.batch([0, 20])

    def test_missing_and_cut_shards(self, own: Path) -> None:
        path = own / "train-00000.safetensors"
        path.write_bytes(path.read_bytes()[:-10])
        with pytest.raises(FixedSetError, match="checksum"):
            FixedSet(own, "train").batch([0])
        path.unlink()
        with pytest.raises(FixedSetError, match="cannot be read"):
            FixedSet(own, "train").batch([0])

    @pytest.mark.parametrize(
        "change",
        [
            {"format": "something else"},
            {"version": 1},
            {"settings": {"pixels": 64}},
            {"settings": []},
            {"shards": []},
            {"shards": {}},
        ],
    )
    def test_other_manifests_are_refused(self, own: Path, change: dict[str, Any]) -> None:
        manifest = json.loads((own / "manifest.json").read_text())
        (own / "manifest.json").write_text(json.dumps({**manifest, **change}))
        with pytest.raises(FixedSetError):
            FixedSet(own, "test")

    def test_no_manifest_at_all(self, tmp_path: Path) -> None:
        with pytest.raises(FixedSetError, match="no fixed set"):
            FixedSet(tmp_path, "train")
        for text in ("", "[" * 100_000, "[1]", "\x00\xff"):
            (tmp_path / "manifest.json").write_text(text)
            with pytest.raises(FixedSetError, match=r"manifest\.json"):
                FixedSet(tmp_path, "train")


class TestCommand:
    def test_makes_goes_on_and_mends(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        folder = tmp_path / "set"
        make = ["dataset", str(folder), "--full-frame", "--pixels", "32", "--train", "6", "--test", "2"]
        assert main.main(make) == main.SUCCESS
        assert "6 + 2 images" in capsys.readouterr().out
        before = contents(folder)
        assert sorted(before) == [
            "manifest.json",
            *(f"{name}.safetensors" for name in ("test-00000", "train-00000")),
        ]
        assert main.main(make) == main.SUCCESS
        assert contents(folder) == before
        (folder / "train-00000.safetensors").write_bytes(b"")
        assert main.main(make) == main.SUCCESS
        assert contents(folder) == before
        assert main.main([*make, "--seed", "9"]) == main.FAILURE
        assert "other settings" in capsys.readouterr().err
        assert FixedSet(folder, "test").settings.dtype == np.uint8

    def test_misuse_is_named(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for wrong in (["--pixels", "1"], ["--seed", "-1"], ["--train", "-3"]):
            assert main.main(["dataset", str(tmp_path), *wrong]) == main.USAGE
            assert wrong[0] in capsys.readouterr().err
