"""Training runs: configuration, schedules, what is left after a kill or a divergence."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch
from python_process import run_python
from safetensors.torch import load_file, save_file

from sq_perception import Camera, Recoverer, Superquadric
from sq_perception.commands import main
from sq_perception.geometry.metrics import volume_iou
from sq_perception.imaging import unit_cube
from sq_perception.learning import checkpoint, train, training_config
from sq_perception.learning.choices import UNSUPERVISED
from sq_perception.learning.dataset import ViewSource, draw_views, full_frames
from sq_perception.learning.inference import predict_in_positions
from sq_perception.learning.losses import Objective
from sq_perception.learning.networks import Regressor, RegressorConfig
from sq_perception.learning.training import mixed_precision
from sq_perception.learning.training_config import Plateau, TrainingConfig
from sq_perception.simulation.scenes import thesis_bodies

SMALL = RegressorConfig(pixels=32, widths=(4, 8, 8), blocks=1, hidden=32)
RUN = TrainingConfig(steps=40, batch=16, points=64, validation=20, warm_up=5, threads=1)


WRONG_SHARES = {"occluded": 1.5, "noisy": -0.1, "pinhole": 2.0, "wide": -1.0}


def log_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def endless(folder: Path, validation: int) -> list[str]:
    options = f"--pixels 16 --batch 4 --points 16 --validation {validation} --threads 1 --steps 100000"
    return [sys.executable, "-m", "sq_perception", "train", "--output", str(folder), *options.split()]


class TestConfig:
    def test_thesis_setting_is_that_of_the_thesis(self) -> None:
        config = training_config.read("thesis")
        assert (config.optimizer, config.learning_rate, config.batch) == ("adam", 1e-4, 32)
        assert config.rate(10**5, 0.1, Plateau(reductions=1)) == pytest.approx(1e-5)
        form = config.regressor()
        assert (form.backbone, form.pixels, form.framing) == ("resnet18", 256, "full")

    def test_command_line_wins_over_the_file(self, tmp_path: Path) -> None:
        for name in training_config.shipped_names():
            assert training_config.read(name, steps=20).steps == 20
        path = tmp_path / "run.yaml"
        path.write_text("steps: 10\nlearning_rate: 1e-4\nbatch: 8\n")
        config = training_config.read(path, steps=20)
        assert (config.steps, config.learning_rate, config.batch) == (20, 1e-4, 8)

    @pytest.mark.parametrize(
        ("text", "complaint"),
        [
            ("stepps: 3", "no setting 'stepps'"),
            ("steps: many", "steps: expected int"),
            ("steps: 2.5", "steps: expected int"),
            ("bfloat16: 1", "bfloat16: expected bool"),
            ("steps: 0", "at least 1"),
            ("points: 1", "at least 2"),  # half of them near the body, half around it: the mean of none is no number
            ("loss: magic", "loss: expected one of"),
            ("[1, 2]", "name: value"),
            ("a: [", "not a YAML file"),
            ("loss: render\noccluded_share: 0.5", "need a loss with labels"),
            ("framing: full\npinhole_share: 0.5", "orthographic"),
            ("sharpness_start: -5", "sharpness_start: expected a finite number"),
            *((f"{name}_share: {value}", f"{name}_share: expected a share") for name, value in WRONG_SHARES.items()),
            ("seed: 18446744073709551616", "seed: expected a number below 2\\^63"),
            ("!!python/object/apply:os.system ['true']", "not a YAML file"),
        ],
    )
    def test_says_what_is_wrong(self, text: str, complaint: str, tmp_path: Path) -> None:
        path = tmp_path / "run.yaml"
        path.write_text(text)
        with pytest.raises(ValueError, match=complaint):
            training_config.read(path)

    def test_command_refuses_with_usage(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main.main(["train", "--config", "nowhere.yaml"]) == main.USAGE
        assert "no such configuration file" in capsys.readouterr().err


class TestValidation:
    def test_no_seed_trains_on_it(self, tmp_path: Path) -> None:
        """NumPy takes [0] and [0, 0, 0], a run's and a set's numbers, for the same seed."""
        kept = train._validation_sets(replace(RUN, validation=8), SMALL)["iou"][1].size
        for seed in ([0], [0, 0], [0, 0, 0]):
            assert not np.isin(kept, thesis_bodies(8, np.random.default_rng(seed)).size).any()

    def test_a_run_that_goes_on_with_other_views_begins_to_compare_anew(self, tmp_path: Path) -> None:
        form = replace(SMALL, marks_hidden=True)
        train.train(RUN, tmp_path, form)
        train.train(replace(RUN, steps=60, noisy_share=0.5, occluded_share=0.5), tmp_path, form)
        metrics = json.loads(checkpoint.read_header(tmp_path / "model.safetensors")["metrics"])
        assert {"iou_worn", "iou_hidden"} <= set(metrics)

    def test_the_form_of_a_start_counts(self, tmp_path: Path) -> None:
        """Full frames that its configuration does not name are no views to put noise on."""
        train.train(replace(RUN, steps=2), tmp_path / "full", replace(SMALL, framing="full"))
        start = str(tmp_path / "full" / "last.safetensors")
        with pytest.raises(ValueError, match="full frames are the thesis' images"):
            train.train(replace(RUN, start=start, noisy_share=0.5), tmp_path / "next")


class TestSchedule:
    def test_cosine_rises_and_falls_to_zero(self) -> None:
        config = TrainingConfig(learning_rate=2.0, warm_up=10)
        rates = [config.rate(step, progress, Plateau()) for step, progress in ((0, 0.0), (50, 0.5), (100, 1.0))]
        assert rates == pytest.approx([0.2, 1.0, 0.0])

    def test_plateau_divides_after_ten_and_ends_after_twenty(self) -> None:
        schedule = Plateau()
        for loss in (3.0, 2.0):
            schedule.record(loss)
        for _ in range(9):
            schedule.record(2.0)
        assert schedule.share == 1.0
        schedule.record(2.5)
        assert schedule.share == pytest.approx(0.1)
        continued = replace(schedule)
        for _ in range(10):
            assert not continued.exhausted
            continued.record(2.0)
        assert continued.exhausted
        assert continued.share == pytest.approx(0.01)
        schedule.record(1.0)
        assert not schedule.exhausted

    def test_plateau_ends_a_run(self, tmp_path: Path) -> None:
        """With a rate of almost nothing there is no progress, and a run of a million steps ends soon."""
        config = replace(RUN, schedule="plateau", learning_rate=1e-12, steps=10**6, validation=2, batch=4, average=0.0)
        train.train(config, tmp_path, SMALL)
        assert 42 <= log_of(tmp_path)[-1]["step"] < 120


class TestLearning:
    def test_learns(self, tmp_path: Path) -> None:
        views, truth = draw_views(60, np.random.default_rng(7), ViewSource(32))
        before = train.validate(Regressor(SMALL), views, truth).mean()
        assert train.validate(train.train(RUN, tmp_path, SMALL), views, truth).mean() > before + 0.05
        records, header = log_of(tmp_path), checkpoint.read_header(tmp_path / "model.safetensors")
        assert [record["step"] for record in records] == [20, 40]
        assert json.loads(header["metrics"])["iou"] == max(record["iou"] for record in records), "the best one is kept"
        assert json.loads(header["training"])["steps"] == 40
        assert json.loads(header["made"])["versions"]["torch"]

    @pytest.mark.parametrize("loss", ["dual", "render"])
    def test_labels_go_to_the_losses_that_need_them_and_to_no_other(self, loss, tmp_path, monkeypatch) -> None:
        given = []
        compute = Objective.loss

        def watched(self: Objective, prediction: Superquadric, views: torch.Tensor, truth: Any, *rest: Any) -> Any:
            given.append(truth is not None)
            return compute(self, prediction, views, truth, *rest)

        monkeypatch.setattr(Objective, "loss", watched)
        train.train(replace(RUN, loss=loss, steps=2), tmp_path, SMALL)
        assert given == [loss not in UNSUPERVISED] * 2
        header = checkpoint.read_header(tmp_path / "model.safetensors")
        assert json.loads(header["training"])["loss"] == loss


@pytest.mark.parametrize("has_products", [False, True])
def test_bfloat16_is_used_where_the_processor_has_it(monkeypatch: pytest.MonkeyPatch, has_products: bool) -> None:
    """Elsewhere a step in it takes 16 times as long."""
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: has_products)
    with mixed_precision("cpu", wanted=True):
        assert torch.is_autocast_enabled("cpu") == has_products
    with mixed_precision("cpu", wanted=False):
        assert not torch.is_autocast_enabled("cpu")


def test_a_thread_count_holds_for_network_and_rendering_and_ends_with_the_run(tmp_path, monkeypatch) -> None:
    """A second thread that waits by spinning starves a run on a busy machine."""
    before, during = (torch.get_num_threads(), numba.get_num_threads()), set()
    draw = train.ViewPool.batch

    def watched(self, count):  # type: ignore[no-untyped-def]
        during.add((torch.get_num_threads(), numba.get_num_threads()))
        return draw(self, count)

    monkeypatch.setattr(train.ViewPool, "batch", watched)
    train.train(replace(RUN, steps=2, validation=2), tmp_path, SMALL)
    assert during == {(1, 1)}
    assert (torch.get_num_threads(), numba.get_num_threads()) == before


def test_one_view_a_step_is_refused_where_nothing_is_left_to_normalise(tmp_path: Path) -> None:
    form = replace(SMALL, pixels=8)
    with pytest.raises(ValueError, match="batch: expected at least 2 with views of 8 pixels"):
        train.train(replace(RUN, batch=1), tmp_path, form)
    train.train(replace(RUN, batch=1, steps=1, average=0.0), tmp_path, replace(form, pixels=16))


class TestInterruptions:
    def test_terminated_run_goes_on_where_it_stopped(self, tmp_path: Path) -> None:
        command = endless(tmp_path, validation=15)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        first = json.loads(process.stdout.readline())
        process.send_signal(signal.SIGTERM)
        _, complaint = process.communicate(timeout=600)
        assert process.returncode == 130
        assert "the same command goes on" in complaint
        state = load_file(str(tmp_path / "state.safetensors"))
        assert int(state["step"]) >= first["step"] == 15
        done = int(state["step"])
        run_python(*command[1:-1], done + 3)
        assert int(load_file(str(tmp_path / "state.safetensors"))["step"]) == done + 3

    def test_killed_run_leaves_whole_files(self, tmp_path: Path) -> None:
        process = subprocess.Popen(endless(tmp_path, validation=2), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        for _ in range(2):  # what the first line tells of is on disk before the second is said
            process.stdout.readline()
        process.kill()
        process.wait(timeout=300)
        process.stdout.close()
        load_file(str(tmp_path / "state.safetensors"))
        assert json.loads(checkpoint.read_header(tmp_path / "last.safetensors")["metrics"])["step"] >= 2
        checkpoint.load(tmp_path / "last.safetensors")

    def test_divergence_keeps_the_last_good_state_and_says_so(self, tmp_path, monkeypatch) -> None:
        train.train(RUN, tmp_path, SMALL)
        before = (tmp_path / "state.safetensors").read_bytes()
        draw = train.ViewPool.batch

        def poisoned(self, count):  # type: ignore[no-untyped-def]
            images, bodies = draw(self, count)
            return images * float("nan"), bodies

        monkeypatch.setattr(train.ViewPool, "batch", poisoned)
        with pytest.raises(ArithmeticError, match=r"step 40.*state\.safetensors is the last good one"):
            train.train(replace(RUN, steps=60), tmp_path, SMALL)
        assert (tmp_path / "state.safetensors").read_bytes() == before
        checkpoint.load(tmp_path / "model.safetensors")

    @pytest.mark.parametrize("validated", [True, False])
    def test_a_folder_of_another_run_is_refused_with_what_differs(self, tmp_path: Path, validated: bool) -> None:
        train.train(replace(RUN, steps=2), tmp_path, SMALL)
        if not validated:  # what a run that is stopped before its first validation leaves
            (tmp_path / "last.safetensors").unlink()
            (tmp_path / "model.safetensors").unlink()
        before = (tmp_path / "state.safetensors").read_bytes()
        with pytest.raises(checkpoint.CheckpointError, match=f"loss '{RUN.loss}', not 'render'"):
            train.train(replace(RUN, steps=4, loss="render"), tmp_path, SMALL)
        assert (tmp_path / "state.safetensors").read_bytes() == before

    def test_foreign_state_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "state.safetensors"
        path.write_bytes(b"not a state")
        with pytest.raises(checkpoint.CheckpointError, match="not the state of such a run"):
            train.train(RUN, tmp_path, SMALL)
        for text in ("", "{", "[1]", "null"):
            save_file({"step": torch.tensor(1)}, str(path), {"training": text} if text else None)
            words = "does not tell what run it is of" if text else "not the state of such a run"
            with pytest.raises(checkpoint.CheckpointError, match=words):
                train.train(RUN, tmp_path, SMALL)

    def test_moments_of_other_weights_are_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "state.safetensors"
        train.train(replace(RUN, steps=1), tmp_path, SMALL)
        save_file({**load_file(str(path)), "optimizer.0.exp_avg": torch.zeros(3)}, str(path))
        with pytest.raises(checkpoint.CheckpointError, match=r"not the state of such a run: optimizer\.0\.exp_avg"):
            train.train(replace(RUN, steps=2), tmp_path, SMALL)


class TestContinuation:
    def test_average_follows_and_is_what_is_saved(self, tmp_path: Path) -> None:
        model = train.train(replace(RUN, average=0.0), tmp_path, SMALL)
        saved = checkpoint.load(tmp_path / "last.safetensors")
        state = load_file(str(tmp_path / "state.safetensors"))
        weight = "size_head.weight"
        torch.testing.assert_close(saved.state_dict()[weight], model.state_dict()[weight], rtol=0, atol=1e-3)
        torch.testing.assert_close(state[f"average.{weight}"], state[f"model.{weight}"])

    def test_start_from_a_file_keeps_its_form_and_learns_what_hidden_means(self, tmp_path: Path) -> None:
        checkpoint.save(tmp_path / "start.safetensors", Regressor(SMALL))
        config = replace(RUN, steps=2, start=str(tmp_path / "start.safetensors"), occluded_share=0.5, noisy_share=0.5)
        assert train.train(config, tmp_path / "run").config == replace(SMALL, marks_hidden=True)
        assert {"iou", "iou_hidden", "iou_worn"} <= set(log_of(tmp_path / "run")[-1])

    @pytest.mark.parametrize("other", [{"pixels": 48}, {"backbone": "resnet18"}, {"framing": "full"}])
    def test_a_start_of_another_form_than_is_asked_for_is_refused(self, other: dict[str, Any], tmp_path: Path) -> None:
        checkpoint.save(tmp_path / "start.safetensors", Regressor(SMALL))
        ((name, value),) = other.items()
        config = replace(RUN, steps=1, start=str(tmp_path / "start.safetensors"), **other)
        with pytest.raises(ValueError, match=f"{name}: expected {getattr(SMALL, name)!r}, .* got {value!r}"):
            train.train(config, tmp_path / "run")


class TestThesisSetting:
    """ResNet-18 on full frames, here of 64 pixels."""

    FORM = replace(RegressorConfig.thesis(), pixels=64)
    RUN = replace(training_config.read("thesis"), steps=3, batch=4, points=32, validation=3, threads=1)

    def test_runs_and_is_recovered_with(self, tmp_path: Path) -> None:
        train.train(self.RUN, tmp_path, self.FORM)
        frame = full_frames(thesis_bodies(1, np.random.default_rng(3)))[0]
        depth = np.where(frame > 0, 1 - frame, np.nan).astype(np.float32)
        recoverer = Recoverer(tmp_path / "model.safetensors", method="network")
        body = recoverer.recover(depth, unit_cube.camera()).bodies[0].superquadric
        model = checkpoint.load(tmp_path / "model.safetensors")
        # Pixels of both sizes lie at column / (n - 1); nearest neighbours make the small frame of the large one.
        chosen = np.rint(np.linspace(0, 255, 64)).astype(int)
        expected = unit_cube.optical_from_cube(
            predict_in_positions(model.predict, frame[None][:, chosen][:, :, chosen])
        )[0]
        assert volume_iou(body, expected) > 0.999

    def test_a_full_frame_has_no_perspective(self, tmp_path: Path) -> None:
        checkpoint.save(tmp_path / "model.safetensors", Regressor(self.FORM))
        recoverer = Recoverer(tmp_path / "model.safetensors", method="network")
        depth, labels = np.full((48, 64), 0.8, np.float32), np.ones((48, 64), np.int32)
        with pytest.raises(ValueError, match="orthographic"):
            recoverer.recover(depth, Camera(64, 48, 50, 50, 32, 24), labels)
