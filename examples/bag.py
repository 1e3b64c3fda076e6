"""A rosbag of depth images without ROS: written, read frame by frame, and tracked (extra 'bags')."""

import numpy as np

import sq_perception as sq
from sq_perception.recordings.frame_file import RecordedFrame, Stamp
from sq_perception.recordings.inputs import RecordedInput
from sq_perception.recordings.result_bag import ResultBag
from sq_perception.simulation.scenes import sample
from sq_perception.tracking.session import TrackingSession

recoverer = sq.Recoverer()
with ResultBag("table.mcap") as bag:  # what a camera and recover_node publish; `recover --mcap` writes the same
    for k in range(3):
        made = sample(seed=k)
        frame = RecordedFrame(made.depth, made.camera, None, f"frame {k}", Stamp(100 + k, 0))
        bag.add(frame, recoverer.recover(frame.depth, frame.camera), None)

session = TrackingSession()
for source, frame in RecordedInput(["table.mcap"]):  # or a folder of a rosbag2, or of images
    found = recoverer.recover(frame.depth, frame.camera)
    tracks = session.follow(found.recovered, frame.stamp.sec, camera=frame.camera, depth=frame.depth)
    print(source, frame.stamp, {track.id: np.round(2e3 * track.superquadric.size).tolist() for track in tracks})
