"""The camera_info topic of a bag's images: the sibling of their topic, as image_transport pairs them, or another one.

Without a sibling the one that has the images' size counts: not a colour camera's, and of several the one with the
images' frame and stamp.  Where that leaves none or several, all are listed and one can be named.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from sq_perception.imaging import compressed_depth
from sq_perception.recordings import publication
from sq_perception.recordings.bag_reader import CAMERA_INFO, BagReader, Message
from sq_perception.recordings.camera_file import FrameError

_COLOUR = re.compile(r"colou?r|rgb(?!d)")


@dataclass(frozen=True)
class InfoTopic:
    """A camera_info topic: its name; why it was taken, where it is no sibling; what to say where it holds nothing."""

    name: str
    note: str = ""
    absent: str = ""


def raw_topic(topic: str) -> str:
    """The topic that shows the images of a compressedDepth topic as they are; any other topic itself."""
    return topic.removesuffix(f"/{compressed_depth.TRANSPORT}")


def camera_info_topic(topic: str) -> str:
    """The camera_info topic of an image topic: the one in its name space."""
    space, slash, _ = raw_topic(topic).rpartition("/")
    return f"{space}{slash}camera_info"


def info_topic(reader: BagReader, topic: str, image: Message | None, wanted: str | None) -> InfoTopic:
    """The camera_info topic for the images of a topic, of which one is given, or the one that was asked for.

    Raises
    ------
    FrameError
        If the bag has not the one that was asked for.
    """
    names = sorted({connection.topic for connection in reader.connections(CAMERA_INFO)})
    listed = ", ".join(names) or "none"
    if wanted is not None:
        wanted = "/" + wanted.lstrip("/")
        if wanted not in names:
            raise FrameError(f"{reader.path}: no camera_info on {wanted}; camera_info topics: {listed}")
        return InfoTopic(wanted)
    own = camera_info_topic(topic)
    choice = "choose one with --camera-info-topic, or name" if names else "name"
    absent = f"no camera_info on {own} (camera_info topics: {listed}): {choice} the camera with --camera-info"
    if own in names or image is None:
        return InfoTopic(own, absent=absent)
    size, header = publication.size_of(image.content), image.content.header
    found: dict[str, Message] = {}
    for name in names:
        if _COLOUR.search(name.lower()) and not _COLOUR.search(topic.lower()):
            continue
        infos = reader.messages(reader.connections(CAMERA_INFO, topic=name))
        first = next((info for info in infos if isinstance(info, Message)), None)
        if first is not None and (first.content.width, first.content.height) == size:
            found[name] = first
    preferences: tuple[Callable[[Message], bool], ...] = (
        lambda info: info.content.header.frame_id == header.frame_id,
        lambda info: info.stamp == image.stamp,
    )
    for fits in preferences:
        found = {name: info for name, info in found.items() if fits(info)} or found
    if len(found) != 1:
        return InfoTopic(own, absent=absent)
    (name,) = found
    return InfoTopic(name, f"the camera is that of {name}, as {own} is not there and it has the size of the images")
