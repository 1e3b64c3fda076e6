"""The evaluation: its figures in closed form, its test set, its tables, and the files of the command."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from sq_perception import Recoverer, Superquadric
from sq_perception.commands import main
from sq_perception.evaluation import contest, evaluation_pictures, thesis_report
from sq_perception.evaluation.contest import CAMERA, Answers, Contestant, ThesisImages, fit, network, unique_names
from sq_perception.evaluation.figures_of_merit import FiguresOfMerit, shortest_arc
from sq_perception.evaluation.thesis_report import NOT_IN_THESIS, NOTHING, Table
from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging import unit_cube
from sq_perception.learning import checkpoint
from sq_perception.learning.networks import Regressor, RegressorConfig
from sq_perception.simulation.scenes import thesis_bodies

LABELS = ThesisImages(40).truth


def scripted(change: Callable[[Superquadric], Superquadric] = lambda body: body) -> Contestant:
    """A contestant that knows the truth and answers with a change of it."""

    def recover(first: int, images: np.ndarray) -> Answers:
        return Answers(change(LABELS[first : first + len(images)]).to_flat(), np.full(len(images), 2.0))

    return Contestant("scripted", "for the test", "", recover, has_canonical_labels=False)


def small_network(path: Path, **training: object) -> Path:
    torch.manual_seed(0)
    model = Regressor(RegressorConfig(pixels=32, widths=(8, 8, 16), blocks=1, hidden=16))
    checkpoint.save(path, model.eval(), {"training": training, "metrics": {"step": 5}})
    return path


def entry(name: str, loss: str | None, **changed: float) -> dict[str, Any]:
    return {"name": name, "loss": loss, "summary": {**FiguresOfMerit.of(LABELS, LABELS).summary(), **changed}}


class TestFigures:
    def test_known_changes_have_their_closed_forms(self) -> None:
        figures = FiguresOfMerit.of(LABELS, LABELS)
        assert (np.stack([figures.iou, figures.volume_iou]) == 1).all()
        for error in (figures.delta_a, figures.delta_e, figures.delta_t, figures.shortest_arc, figures.axes_angle):
            assert np.abs(error).max() < 1e-7
        shift = np.array([0.01, -0.02, 0.03])
        changed = Superquadric(1.1 * LABELS.size, 0.9 * LABELS.shape, LABELS.translation + shift, LABELS.rotation)
        found = FiguresOfMerit.of(changed, LABELS).summary()
        assert (found["delta_a"], found["delta_e"]) == (pytest.approx(1.1**3 - 1), pytest.approx(-0.1))
        assert found["delta_t"] == pytest.approx(tuple(shift))
        assert 0.4 < found["iou_mean"] < 1 / 1.1**3

    def test_the_eight_forms_change_neither_iou_nor_the_symmetric_angle(self) -> None:
        angles = []
        for k, form in enumerate(LABELS.equivalent_forms()):
            figures = FiguresOfMerit.of(form, LABELS)
            assert figures.iou.min() > 0.999
            assert figures.symmetric_angle.max() < 1e-6
            assert figures.any_order_angle.max() < 1e-6
            assert (figures.axes_angle.max() < 1e-6) == (k < 4)
            angles.append(figures.shortest_arc.mean())
        assert np.ptp(angles) > 1

    def test_each_angle_forgives_what_it_says(self) -> None:
        about_z, cycle = [0, 0, np.sqrt(0.5), np.sqrt(0.5)], [0.5, 0.5, 0.5, 0.5]
        for turn, axes, symmetric, any_order in ((about_z, 90, 0, 0), (cycle, 120, 90, 0)):
            turned = quaternions.multiply(LABELS.rotation, np.array(turn) + np.zeros_like(LABELS.rotation))
            figures = FiguresOfMerit.of(Superquadric(LABELS.size, LABELS.shape, LABELS.translation, turned), LABELS)
            assert np.rad2deg(figures.axes_angle) == pytest.approx(axes, abs=1e-4)
            assert np.rad2deg(figures.symmetric_angle) == pytest.approx(symmetric, abs=1e-4)
            assert np.rad2deg(figures.any_order_angle) == pytest.approx(any_order, abs=1e-4)
            assert figures.summary()["quarter_turns"] == (axes == 90)

    @pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 180.0, 270.0, 359.0])
    def test_the_shortest_arc_runs_to_two_pi_as_in_figure_6_3(self, degrees: float) -> None:
        half = np.deg2rad(degrees) / 2
        turn = np.array([np.sin(half), 0, 0, np.cos(half)])
        turned = quaternions.multiply(LABELS.rotation, turn + np.zeros_like(LABELS.rotation))
        assert np.rad2deg(shortest_arc(LABELS.rotation, turned)) == pytest.approx(degrees, abs=1e-5)
        assert np.rad2deg(shortest_arc(LABELS.rotation, -turned)) == pytest.approx(360 - degrees, abs=1e-5)

    def test_what_was_not_recovered_has_iou_0_and_no_errors(self) -> None:
        found = FiguresOfMerit.of(LABELS, LABELS, np.arange(40) % 4 > 0)
        assert found.summary()["iou_mean"] == pytest.approx(0.75)
        assert (found.summary()["recovered"], found.summary()["delta_a"]) == (30, 0)
        nothing = FiguresOfMerit.of(LABELS, LABELS, np.zeros(40, bool)).summary()
        assert (nothing["recovered"], nothing["timed"], nothing["iou_mean"]) == (0, 0, 0)
        assert np.isnan(nothing["delta_a"])


class TestImages:
    def test_the_first_bodies_are_the_same_however_many_there_are(self) -> None:
        np.testing.assert_array_equal(ThesisImages(700).truth.to_flat()[:40], LABELS.to_flat())
        assert not np.isin(ThesisImages(40, seed=7).truth.size, LABELS.size).any()

    def test_no_training_draws_them(self) -> None:
        sizes = ThesisImages(1000).truth.size
        for seed in (0, 2020, [2020, 0], [1, 0], [11, 0]):
            assert not np.isin(thesis_bodies(1000, np.random.default_rng(seed)).size, sizes).any()

    def test_chunks_hold_every_image_once_in_8_bits(self, monkeypatch: pytest.MonkeyPatch) -> None:
        images = ThesisImages(5)
        monkeypatch.setattr(contest, "CHUNK", 2)
        chunks = list(images.chunks())
        assert [(first, len(depth)) for first, depth in chunks] == [(0, 2), (2, 2), (4, 1)]
        np.testing.assert_array_equal(chunks[1][1][1], images.image(3))
        grey = (1 - images.image(3)) * 255 - 0.5
        np.testing.assert_allclose(grey[np.isfinite(grey)] % 1, 0.5, atol=0.5)
        assert images.image(3).shape == (256, 256)

    def test_misuse_is_refused(self) -> None:
        for wrong in ({"count": 0}, {"count": 3, "seed": -1}):
            with pytest.raises(ValueError, match="expected"):
                ThesisImages(**wrong)
        with pytest.raises(ValueError, match="expected 1 to 3"):
            contest.compare([(scripted(), 4)], ThesisImages(3))


class TestContest:
    def test_chunks_do_not_change_the_result(self, monkeypatch: pytest.MonkeyPatch) -> None:
        alone, classic = network(checkpoint.resolve()), fit("classic")
        results = []
        for chunk in (2, 7):
            monkeypatch.setattr(contest, "CHUNK", chunk)
            results.append(contest.compare([(alone, 7), (classic, 4)], ThesisImages(7)))
        for small, large in zip(*results, strict=True):
            np.testing.assert_allclose(small.bodies.to_flat(), large.bodies.to_flat(), atol=1e-4)
            np.testing.assert_allclose(small.figures.iou, large.figures.iou, atol=1e-3)
        assert [len(outcome.figures) for outcome in results[0]] == [7, 4]

    def test_a_network_recovers_what_the_recovery_recovers(self) -> None:
        """In batches and one by one: two ways to the same bodies."""
        ((first, depths),) = ThesisImages(6).chunks()
        answers = network(checkpoint.resolve()).recover(first, depths)
        recoverer = Recoverer(method="network")
        for depth, flat in zip(depths, answers.bodies, strict=True):
            (found,) = recoverer.recover(depth, CAMERA).bodies
            body = unit_cube.cube_from_optical(found.superquadric).canonical_form()
            same = Superquadric.from_flat(flat).canonical_form()
            np.testing.assert_allclose(same.to_flat(), body.to_flat(), atol=1e-4)
        assert (answers.milliseconds > 0).all()

    def test_an_empty_image_is_a_body_not_recovered(self) -> None:
        ((first, depths),) = ThesisImages(2).chunks()
        depths[1] = np.nan
        for contestant in (network(checkpoint.resolve()), fit("symmetry")):
            bodies, _ = contestant.recover(first, depths)
            assert np.isfinite(bodies).all(axis=1).tolist() == [True, False]

    @pytest.mark.parametrize("canonical", [False, True])
    def test_what_is_given_is_that_of_the_label_as_the_training_listed_it(self, tmp_path, canonical) -> None:
        path = small_network(tmp_path / "a.safetensors", loss="occupancy_rotation", canonical_labels=canonical)
        alone = network(path)
        labels = alone.labels(LABELS)
        compared = alone.with_given(Superquadric.from_flat(LABELS.to_flat()[::-1]), labels)
        np.testing.assert_array_equal(compared.size, labels.size)
        np.testing.assert_allclose(compared.rotation, LABELS.rotation[::-1], atol=1e-12)
        assert (labels.size[:, 0] >= labels.size[:, 1]).all() == canonical

    def test_names_are_unique(self, tmp_path: Path) -> None:
        paths = [tmp_path / f"{name}.safetensors" for name in ("render/model", "render", "auto")]
        assert unique_names(paths) == ["render", "render_2", "auto_2"]
        assert unique_names([Path('<b "x">.safetensors')]) == ["_b_x_"]


class TestTables:
    def test_every_table_of_the_thesis_is_there_and_says_where_there_is_nothing(self) -> None:
        tables = thesis_report.thesis_tables([])
        titles = " ".join(table.title for table in tables)
        assert all(f"Table {number}" in titles for number in ("6.1", "6.2", "6.3", "7.1", "7.2", "7.3", "7.4"))
        for table in tables:
            ours = [name != "Method" and "thesis" not in name for name in table.header]
            assert all([cell == NOTHING for cell in row] == ours for row in table.rows)

    def test_losses_answer_the_rows_of_the_thesis(self) -> None:
        known = (("shipped", "occupancy", 0.9), ("free", "least_squares_free", 0.8))
        known += (("classic", None, 0.7), ("auto", None, 0.99))
        results = [entry(name, loss, iou_mean=iou) for name, loss, iou in known]
        tables = {table.title.split(":")[0]: table for table in thesis_report.thesis_tables(results)}
        rows = {row[0]: row for row in tables["Table 7.4"].rows}
        assert rows["supervised, L_OC"][1:4] == ("shipped", "90.00 ± 0.00 %", "94.62 ± 3.18 %")
        assert rows["Iterative (Solina and Bajcsy)"][1:4] == ("classic", "70.00 ± 0.00 %", "84.51 ± 8.89 %")
        assert (rows["unsupervised, L_LS and free space"][3], rows["unsupervised, L_LS"][1]) == (NOT_IN_THESIS, NOTHING)
        assert rows["supervised, L_OC"][4] == "not timed"
        assert not any("auto" in row for table in tables.values() for row in table.rows)
        assert [len(table.rows) for table in thesis_report.overview(results)] == [4, 4]

    def test_two_networks_of_one_loss_are_two_rows(self) -> None:
        results = [entry(name, "render") for name in ("first", "second")]
        (table,) = (one for one in thesis_report.thesis_tables(results) if one.title.startswith("Table 7.2"))
        assert [row[1] for row in table.rows if row[0].endswith("L_DR")] == ["first", "second"]

    def test_cells_are_escaped_and_have_no_minus_zero(self) -> None:
        assert "a\\|L_OC" in Table("t", ("Method",), (("a|L_OC",),)).markdown()
        assert thesis_report.signed(-1e-6) == "+0.00 %"


def test_examples_are_chosen_by_rank() -> None:
    scale = np.linspace(1, 0.7, 40)[np.random.default_rng(0).permutation(40)]

    def change(body: Superquadric) -> Superquadric:
        return Superquadric(scale[: len(body), None] * body.size, body.shape, body.translation, body.rotation)

    for count in (1, 2, 5, 9, 40):
        (outcome,) = contest.compare([(scripted(change), count)], ThesisImages(count))
        groups = evaluation_pictures.rank(outcome)
        numbers = [number for group in groups.values() for number in group]
        assert len(set(numbers)) == len(numbers) == min(count, 9) or count in (2, 5)
        assert outcome.figures.iou[groups["best"][0]] == outcome.figures.iou.max()
        assert (np.diff(outcome.figures.iou[numbers]) <= 0).all()
    assert [len(group) for group in groups.values()] == [3, 3, 3]
    assert outcome.figures.iou[groups["median"][1]] == pytest.approx(np.median(outcome.figures.iou), abs=0.02)
    assert outcome.figures.iou[groups["worst"][-1]] == outcome.figures.iou.min()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The command on 20 bodies: a network, one that is damaged, the classic fit."""
    folder = tmp_path_factory.mktemp("evaluation")
    good = small_network(folder / "small" / "model.safetensors", loss="render")
    bad = folder / "bad <&>.safetensors"
    bad.write_bytes(good.read_bytes()[:1000])
    arguments = ["--bodies", "20", "--fit-bodies", "6", "--models", str(good), str(bad), "--methods", "classic"]
    return folder / "out", main.main(["evaluate", *arguments, "--output", str(folder / "out")])


class TestCommand:
    def test_a_damaged_model_is_said_and_the_rest_is_there(self, run: tuple[Path, int]) -> None:
        folder, code = run
        assert code == main.FAILURE
        document = json.loads((folder / "results.json").read_text(), parse_constant=pytest.fail)
        assert "bad <&>" in document["failures"][0]
        assert [entry["name"] for entry in document["contestants"]] == ["small", "classic"]
        assert [entry["summary"]["bodies"] for entry in document["contestants"]] == [20, 6]
        assert document["contestants"][0]["loss"] == "render"
        assert {"command", "versions", "processor", "commit", "seed", "threads"} <= set(document["facts"])

    def test_all_files_are_there(self, run: tuple[Path, int]) -> None:
        folder, _ = run
        kinds = ("small_distributions", "small_examples", "classic_distributions", "classic_examples")
        assert {path.stem for path in folder.glob("*.png")} == set(kinds)
        for kind in kinds:
            assert cv2.imread(str(folder / f"{kind}.png")).std() > 5
        text = (folder / "report.md").read_text()
        assert "Table 7.4" in text
        assert "| unsupervised, L_DR | small |" in text
        assert all(f"(<{kind}.png>)" in text for kind in kinds)

    def test_wrong_usage_is_refused(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        few = ["--bodies", "0"], ["--fit-bodies", "-1"], ["--seed", "-1"]
        for wrong in (*few, ["--methods", "magic"], ["--models", "--methods"], ["--output", str(tmp_path / "file")]):
            assert main.main(["evaluate", *wrong]) == main.USAGE
            assert "expected" in (said := capsys.readouterr().err) or "choose" in said or "--" in said

    def test_nothing_left_is_a_failure(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = ["evaluate", "--models", str(tmp_path / "missing"), "--methods", "--output", str(tmp_path / "out")]
        assert main.main(arguments) == main.FAILURE
        assert "no such model file" in capsys.readouterr().err
        assert not (tmp_path / "out" / "report.md").exists()
