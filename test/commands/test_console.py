"""What all commands have in common: what is read stays, what is printed arrives, and every name will do."""

from __future__ import annotations

import cv2
import numpy as np
import yaml

from sq_perception.commands import main

CAMERA = {"image_width": 40, "image_height": 30, "camera_matrix": {"data": [50, 0, 19.5, 0, 50, 14.5, 0, 0, 1]}}


def recover(*arguments):
    return main.main(["recover", *map(str, arguments), "--method", "symmetry"])


def test_neither_masks_nor_cameras_nor_the_files_of_a_bag_are_replaced(tmp_path, capsys):
    """Files that were not named themselves, but are read for those that were."""
    folder, masks, bag = (tmp_path / name for name in ("frames", "masks", "bag"))
    for made in (folder, masks, bag):
        made.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((30, 40), 1000, np.uint16))
    cv2.imwrite(str(masks / "a.png"), np.ones((30, 40), np.uint8))
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA))
    for name in ("metadata.yaml", "bag.mcap"):
        (bag / name).write_text("recorded")
    kept = [folder / "camera.yaml", masks / "a.png", bag / "metadata.yaml", bag / "bag.mcap"]
    before = [path.read_bytes() for path in kept]
    for arguments in (
        (folder, "--masks", masks, "--pictures", masks),
        (folder, "--json", folder / "camera.yaml"),
        (bag, "--mcap", bag / "bag.mcap"),
    ):
        assert recover(*arguments) == 2
        assert "input" in capsys.readouterr().err
    assert [path.read_bytes() for path in kept] == before
