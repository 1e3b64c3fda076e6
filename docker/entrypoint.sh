#!/bin/bash
# Both setups and the environment of the dependencies, then the command.
set -e
source /home/ros/env/bin/activate
source /opt/ros/jazzy/setup.bash
source /home/ros/ws/install/setup.bash
exec "$@"
