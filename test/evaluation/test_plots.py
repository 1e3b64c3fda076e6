"""Pictures: outlines where the bodies are, views from where they say, and no global Matplotlib state."""


import cv2
import numpy as np
import pytest
from python_process import run_python

from sq_perception import Camera, Recoverer, Superquadric
from sq_perception.evaluation import plots
from sq_perception.evaluation.recovery_figure import recovery_figure
from sq_perception.geometry.mesh import outline
from sq_perception.grasping.gripper import PANDA
from sq_perception.grasping.plan import Grasp, GraspPlan
from sq_perception.imaging import raycast, unit_cube

CAMERA = Camera(160, 120, 135.0, 135.0, 79.5, 59.5)
BODY = Superquadric([0.08, 0.06, 0.1], [0.3, 0.8], [0.02, 0.01, 0.7], [0.4, 0.2, 0.1, 0.9])
IN_CUBE = unit_cube.optical_from_cube(Superquadric([0.3, 0.2, 0.1], BODY.shape, [0.5] * 3, BODY.rotation))
PLANE = np.array([0.0, -1.0, 0.0, 0.15])


def shot(body=BODY, camera=CAMERA):
    depth, index = raycast.render(body, camera)
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32), (index + 1).astype(np.int32)


@pytest.mark.parametrize("camera", [CAMERA, unit_cube.camera(96), Camera(2000, 1500, 1700, 1700, 999.5, 749.5)])
def test_the_silhouette_encloses_the_pixels_of_the_body(camera):
    body = BODY if camera.is_pinhole else IN_CUBE
    _, index = raycast.render(body, camera)
    (loop,) = plots.silhouettes(body, camera)
    filled = np.zeros(index.shape, np.uint8)
    cv2.fillPoly(filled, [np.round(16 * loop).astype(np.int32)], 1, shift=4)
    assert np.sum((filled > 0) != (index >= 0)) < 2.5 * len(np.unique(np.round(loop), axis=0))
    assert not plots.silhouettes(Superquadric(body.size, body.shape, [0, 0, -5.0], body.rotation), CAMERA)


def drawn(figure):
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(float)


def one_picture(inches=(6.4, 4.8)):
    figure = plots.new_figure(*inches)
    return figure, figure.add_axes((0, 0, 1, 1))


def test_outlines_lie_on_the_depth_picture():
    depth, labels = shot()
    figure, ax = one_picture()
    plots.draw_depth(ax, np.where(np.isfinite(depth), depth, 1.2))
    before = drawn(figure)
    plots.draw_outlines(ax, [BODY], CAMERA, edges=False)
    changed = np.abs(drawn(figure) - before).sum(axis=2) > 60
    changed = cv2.resize(changed.astype(np.uint8), (160, 120), interpolation=cv2.INTER_AREA) > 0
    edge = cv2.morphologyEx((labels > 0).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    assert changed.sum() > 100
    assert (edge[changed]).mean() > 0.95


def test_scores_of_grasps_can_be_read_where_the_picture_is_dark():
    """Where nothing is measured the picture is as dark as the letters."""
    grasp = Grasp(0, BODY.translation, np.array([0, 0, 0, 1.0]), 0.08, 0.06, 0.875, "")
    figure, ax = one_picture()
    depth = np.full((CAMERA.height, CAMERA.width), np.nan)
    plots.draw_grasps(ax, depth, CAMERA, [BODY], GraspPlan((grasp,), ("",)), PANDA)
    drawn(figure)
    (label,) = ax.texts
    box = label.get_window_extent()
    letters = drawn(figure)[int(480 - box.y1) : int(480 - box.y0), int(box.x0) + 12 : int(box.x1)]
    assert np.ptp(letters.mean(axis=2)) > 150


def test_grippers_beyond_the_image_are_shown_whole_and_a_body_without_grasp_says_why():
    """A hand above the upper border, whose end and score were cut off; and words at the right border."""
    aside = Superquadric(BODY.size, BODY.shape, BODY.translation + np.array([0.25, 0.0, 0.0]), BODY.rotation)
    down = np.array([np.sin(-np.pi / 4), 0, 0, np.cos(np.pi / 4)])  # approaches along the image's y axis
    grasp = Grasp(0, BODY.translation - np.array([0, 0.28, 0]), down, 0.08, 0.06, 0.875, "")
    figure, ax = one_picture()
    depth = np.full((CAMERA.height, CAMERA.width), 0.8)
    plan = GraspPlan((grasp,), ("", "too wide for the gripper"))
    plots.draw_grasps(ax, depth, CAMERA, [BODY, aside], plan, PANDA, numbers=[0, 3])
    drawn(figure)
    score, reason = ax.texts
    assert (score.get_text().strip(), reason.get_text().strip()) == ("0: 0.88", "3: too wide for the gripper")
    frame = ax.get_window_extent()
    for words in (score, reason):
        box = words.get_window_extent()
        assert frame.x0 <= box.x0 < box.x1 <= frame.x1
        assert frame.y0 <= box.y0 < box.y1 <= frame.y1
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    wires = CAMERA.project(np.concatenate([grasp.to_body_frame(line) for line in PANDA.wires(grasp.opening)]))
    assert wires[:, 1].min() < 0, "beyond the image"
    assert ((wires >= [left, top]) & (wires <= [right, bottom])).all()


def test_a_view_from_the_camera_s_side_looks_like_the_image():
    """A ball left of a box stays on the left from the front; from the right the box hides it."""
    left = Superquadric([0.05] * 3, [1.0, 1.0], [-0.2, 0, 1.0], [0, 0, 0, 1.0])
    right = Superquadric([0.05] * 3, [0.1, 0.1], [0.2, 0, 1.0], [0, 0, 0, 1.0])
    red, blue = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])

    def middle(azimuth):
        figure, ax = one_picture((4, 4))
        plots.draw_bodies_3d(ax, [left, right], colours=[red, blue], elevation=0, azimuth=azimuth)
        picture = drawn(figure)
        difference = picture[..., 0] - picture[..., 2]
        return np.nonzero(difference > 60)[1], np.nonzero(difference < -60)[1]

    reddish, bluish = middle(0)
    assert reddish.mean() < bluish.mean() - 100
    reddish, bluish = middle(180)
    assert reddish.mean() > bluish.mean() + 100
    reddish, bluish = middle(90)
    assert reddish.size < 0.02 * bluish.size


def test_figures_of_full_and_empty_frames(tmp_path):
    depth, labels = shot()
    recoverer = Recoverer(method="symmetry")
    found = recoverer.recover(depth, CAMERA, labels)
    full = cv2.imread(str(plots.save(recovery_figure(depth, CAMERA, found, "one"), tmp_path / "one.png")))
    nothing = np.full_like(depth, np.nan)
    empty_frame = recoverer.recover(nothing, CAMERA)
    empty = cv2.imread(str(plots.save(recovery_figure(nothing, CAMERA, empty_frame), tmp_path / "none.png")))
    assert full.shape == empty.shape
    assert full.std() > 20


def test_numbers_of_a_body_in_the_cube_are_beside_each_other():
    camera = unit_cube.camera(96)
    depth, labels = shot(IN_CUBE, camera)
    figure = recovery_figure(depth, camera, Recoverer(method="symmetry").recover(depth, camera, labels))
    figure.canvas.draw()
    edges, exponents = (
        next(text for text in figure.axes[-1].texts if text.get_text().startswith(start)) for start in ("0.6", "e ")
    )
    assert edges.get_text().count("+-0.000") == 3
    assert edges.get_window_extent().x1 < exponents.get_window_extent().x0


def test_draw_on_a_plane_with_points_and_true_wires():
    figure, ax = one_picture((4, 4))
    depth, labels = shot()
    v, u = np.nonzero(labels)
    plots.draw_bodies_3d(ax, [BODY], [CAMERA.unproject(u, v, depth[v, u])], PLANE, wires=list(outline(BODY)))
    assert drawn(figure).std() > 20
    empty, ax = one_picture((2, 2))
    plots.draw_bodies_3d(ax, [])
    assert drawn(empty).min() == 255


def test_pyplot_is_not_imported():
    code = "import sys, sq_perception.evaluation.plots; assert 'matplotlib.pyplot' not in sys.modules"
    run_python("-c", code)
