"""Fixed sets: the same to the bit when made again, whole after a kill, true to their bodies, and safe to read."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file, save

from sq_perception.commands import main
from sq_perception.geometry import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.learning import fixed_set, fixed_set_writer
from sq_perception.learning.dataset import ViewSource, draw_views
from sq_perception.learning.dihedral import moved_bodies, moved_images
from sq_perception.learning.fixed_set import FixedSet, FixedSetError, Settings, ShuffledBatches, verify
from sq_perception.learning.fixed_set_writer import draw, generate
from sq_perception.simulation import view_rendering

VIEWS = Settings("cropped", 24, 16, train=50, test=7, shard=16, seed=5)
FULL = Settings("full", 48, 8, train=20, test=5, shard=8, seed=5)


def made(folder: Path, settings: Settings) -> Path:
    generate(folder, settings, threads=1)
    return folder


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("views"), VIEWS)


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("full"), FULL)


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
        assert contents(made(tmp_path / "again", settings)) == contents(views if settings is VIEWS else full)

    def test_a_shard_does_not_depend_on_the_others(self) -> None:
        alone = draw(VIEWS, "train", 2)
        longer = draw(Settings("cropped", 24, 16, train=500, test=0, shard=16, seed=5), "train", 2)
        for mine, theirs in zip(alone, longer, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        others = [draw(VIEWS, "train", 1), draw(VIEWS, "test", 0)]
        assert not any(np.isin(other[1][:, 0], alone[1][:, 0]).any() for other in others)

    def test_after_a_kill_it_goes_on_to_the_same_set(
        self, views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = tmp_path / "killed"

        def dies(path: Path, content: bytes) -> None:
            if path.name == "train-00002.safetensors":
                path.with_name(path.name + ".partial").write_bytes(content[:1000])
                raise KeyboardInterrupt
            replace(path, content)

        replace = fixed_set_writer._replace
        monkeypatch.setattr(fixed_set_writer, "_replace", dies)
        with pytest.raises(KeyboardInterrupt):
            generate(folder, VIEWS)
        with pytest.raises(FixedSetError, match="not finished"):
            FixedSet(folder, "train")
        assert any("not made yet" in complaint for complaint in verify(folder))
        monkeypatch.setattr(fixed_set_writer, "_replace", replace)
        before = (folder / "train-00000.safetensors").stat().st_mtime_ns
        generate(folder, VIEWS)
        assert (folder / "train-00000.safetensors").stat().st_mtime_ns == before
        assert contents(folder) == contents(views)

    def test_lost_cut_and_altered_shards_are_made_again(self, own: Path, views: Path) -> None:
        (own / "train-00000.safetensors").unlink()
        cut, altered = own / "train-00001.safetensors", own / "test-00000.safetensors"
        cut.write_bytes(cut.read_bytes()[:700])
        altered.write_bytes(altered.read_bytes()[:-1] + b"?")
        assert len(verify(own)) == 3
        generate(own, VIEWS)
        assert verify(own) == []
        assert contents(own) == contents(views)

    def test_another_set_is_never_overwritten(self, own: Path) -> None:
        before = contents(own)
        with pytest.raises(FixedSetError, match="other settings"):
            generate(own, Settings("cropped", 24, 16, train=50, test=7, shard=16, seed=6))
        assert contents(own) == before
        (own / "manifest.json").unlink()
        with pytest.raises(FixedSetError, match="choose another folder"):
            generate(own, VIEWS)

    @pytest.mark.parametrize(
        "wrong",
        [
            {"pixels": 1},
            {"bits": 12},
            {"train": -1},
            {"shard": 0},
            {"shard": 1, "train": 10_000_000},
            {"framing": "view"},
            {"framing": "full", "pinhole_share": 0.5},
            {"pinhole_share": float("nan")},
            {"seed": 1.5},
        ],
    )
    def test_misuse_is_named(self, wrong: dict[str, Any]) -> None:
        with pytest.raises(
            ValueError, match=f"^{'pinhole_share' if len(wrong) == 2 and 'framing' in wrong else next(iter(wrong))}:"
        ):
            Settings(**wrong)


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

    def test_any_order_and_a_cache_of_one_shard(self, views: Path) -> None:
        chosen = np.random.default_rng(0).integers(50, size=40)
        images, bodies = FixedSet(views, "train", cache=1).batch(chosen)
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
        with pytest.raises(ValueError, match="integers"):
            split.batch(np.array([0.5]))
        with pytest.raises(ValueError, match="split"):
            FixedSet(views, "validation")

    def test_batches_show_everything_once_a_round(self, views: Path) -> None:
        batches = ShuffledBatches(FixedSet(views, "train"), np.random.default_rng(0), positions=False)
        sizes = np.concatenate([batches.batch(25)[1].size[:, 0] for _ in range(4)])
        assert len(np.unique(sizes)) == 50
        assert len(np.unique(sizes[:50])) == 50
        assert (sizes[:50] != sizes[50:]).any()

    def test_batches_turn_images_with_their_bodies(self, views: Path) -> None:
        images, bodies = ShuffledBatches(FixedSet(views, "train"), np.random.default_rng(1)).batch(50)
        again, _ = view_rendering.render_views(bodies, 24)
        assert np.abs(again - images).mean() < 0.01
        plain, _ = ShuffledBatches(FixedSet(views, "train"), np.random.default_rng(1), positions=False).batch(50)
        assert (np.abs(plain - images).mean(axis=(1, 2)) > 0.01).sum() > 30

    def test_dihedral_positions_hold_for_full_frames(self, full: Path) -> None:
        """Pixels at column / (n - 1) lie symmetrically about 1/2 too: a turned frame is that of the turned body."""
        images, bodies = FixedSet(full, "train").batch(range(16))
        turns, mirror = np.arange(16) % 4, np.arange(16) // 4 % 2 == 0
        turned, moved = moved_images(images, turns, mirror), moved_bodies(bodies, turns, mirror)
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
        (complaint,) = verify(own)
        assert "train-00001.safetensors: damaged, its checksum" in complaint
        split = FixedSet(own, "train")
        split.batch([0, 40])
        with pytest.raises(FixedSetError, match="checksum"):
            split.batch([0, 20])

    def test_missing_and_cut_shards(self, own: Path) -> None:
        path = own / "train-00000.safetensors"
        path.write_bytes(path.read_bytes()[:-10])
        with pytest.raises(FixedSetError, match="bytes instead of"):
            FixedSet(own, "train").batch([0])
        path.unlink()
        with pytest.raises(FixedSetError, match="cannot be read"):
            FixedSet(own, "train").batch([0])

    def forged(self, folder: Path, content: bytes) -> None:
        """A test shard of any content, with the right checksum."""
        (folder / "test-00000.safetensors").write_bytes(content)
        manifest = json.loads((folder / "manifest.json").read_text())
        digest = fixed_set.sha256(folder / "test-00000.safetensors")
        manifest["shards"]["test-00000.safetensors"].update(bytes=len(content), sha256=digest)
        (folder / "manifest.json").write_text(json.dumps(manifest))
        with pytest.raises(FixedSetError, match=r"test-00000\.safetensors"):
            FixedSet(folder, "test").batch(range(7))

    def test_forged_shards_raise_and_no_more(self, own: Path) -> None:
        good = load_file(str(own / "test-00000.safetensors"))
        self.forged(own, b"")
        self.forged(own, b"no tensors at all")
        self.forged(own, struct.pack("<Q", 2**62) + b"{}")
        header = json.dumps({"image": {"dtype": "U8", "shape": [2**50], "data_offsets": [0, 2**50]}}).encode()
        self.forged(own, struct.pack("<Q", len(header)) + header)
        bombs = cv2.imencode(".png", np.zeros((3000, 3000), np.uint16))[1].ravel()
        for change in (
            {"body": good["body"][:-1]},
            {"body": np.full_like(good["body"], np.nan)},
            {"body": good["body"].astype(np.float64)},
            {"offset": good["offset"][::-1].copy()},
            {"offset": good["offset"] * 2},
            {"offset": np.full_like(good["offset"], 2**62)},
            {"offset": np.concatenate([[0, 2**63 - 1, -(2**63) + 100], good["offset"][3:]])},
            {"image": np.zeros_like(good["image"])},
            {"image": good["image"].reshape(1, -1)},
            {"image": np.tile(bombs, 7), "offset": np.arange(8) * len(bombs)},
            {"image": np.tile(good["image"][:40], 7), "offset": np.arange(8) * 40},
        ):
            self.forged(own, save({**good, **change}))
        self.forged(own, save({"image": good["image"], "body": good["body"]}))

    @pytest.mark.parametrize(
        "change",
        [
            {"format": "something else"},
            {"version": 2},
            {"settings": {"pixels": 10**9}},
            {"settings": []},
            {"shards": []},
            {"shards": {"test-00000.safetensors": {"bodies": 7}}},
            {"shards": {"test-00000.safetensors": None}},
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
    def test_makes_goes_on_and_verifies(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        folder = tmp_path / "set"
        make = ["dataset", str(folder), "--full-frame", "--pixels", "32", "--train", "6", "--test", "2", "--shard", "4"]
        assert main.main(make) == main.SUCCESS
        assert "6 + 2 images" in capsys.readouterr().out
        before = contents(folder)
        assert sorted(before) == [
            "manifest.json",
            *(f"{name}.safetensors" for name in ("test-00000", "train-00000", "train-00001")),
        ]
        assert main.main(make) == main.SUCCESS
        assert contents(folder) == before
        assert main.main(["dataset", str(folder), "--verify"]) == main.SUCCESS
        (folder / "train-00001.safetensors").write_bytes(b"")
        capsys.readouterr()
        assert main.main(["dataset", str(folder), "--verify"]) == main.FAILURE
        assert "train-00001.safetensors: damaged, 0 bytes" in capsys.readouterr().err
        assert main.main([*make, "--seed", "9"]) == main.FAILURE
        assert "other settings" in capsys.readouterr().err
        assert FixedSet(folder, "test").settings.bits == 8

    def test_misuse_is_refused_in_words(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for wrong in (["--pixels", "0"], ["--shard", "0"], ["--threads", "-1"], ["--bits", "9"], ["--train", "-3"]):
            assert main.main(["dataset", str(tmp_path), *wrong]) == main.USAGE
            assert wrong[0] in capsys.readouterr().err
        assert main.main(["dataset", str(tmp_path / "missing"), "--verify"]) == main.FAILURE
        assert "no fixed set" in capsys.readouterr().err
