"""Package of sq_perception and sq_msgs_py, for pip and for colcon (ament_python).

Version, description, maintainer, license and address are those of package.xml.
"""

import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

HERE = Path(__file__).resolve().parent
ABOUT = ElementTree.parse(HERE / "package.xml").getroot()  # noqa: S314 - our own
NAME = ABOUT.findtext("name")
NODES = ("recover_node", "recover_cameras", "fitter_node", "grasp_node", "synthetic_depth_node")

SUBPACKAGES = (
    "geometry",
    "files",
    "imaging",
    "segmentation",
    "simulation",
    "fitting",
    "grasping",
    "learning",
    "tracking",
    "recovery",
    "recordings",
    "evaluation",
    "nodes",
    "commands",
)

share = [
    ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
    (f"share/{NAME}", ["package.xml"]),
    (f"share/{NAME}/launch", sorted(glob("launch_scripts/*.py"))),
    (f"share/{NAME}/config", sorted(glob("config/*.xml") + glob("config/*.yaml") + glob("config/*.rviz"))),
]
# `ros2 run` looks for lib/<package>/<executable>.  colcon puts the scripts there itself (setup.cfg); pip puts them into
# bin/, so that a wheel has to carry a way from the one to the other.
if "bdist_wheel" in sys.argv:
    share.append((f"lib/{NAME}", [f"resource/ros2_run/{node}" for node in NODES]))

bags = [
    "rosbags>=0.11.9,<0.12",  # rosbag2 without ROS; its tables of decompressors are no promise beyond
    "mcap>=1.2,<2",  # writes MCAP files, by the authors of the format
]
exr = [
    "OpenEXR>=3.3,<4",  # depth images of renderers; OpenCV's wheels are built without; 2 MB
]
train = [
    # Training, graphics cards, ResNet-18 and the soft renderer.  The tests of learning pass with 2.3.0, 2.13.0, 2.14.1.
    "torch>=2.3,<2.15",
]
picking = [
    "mujoco==3.3.7",  # the physics of benchmarks/picking.py; another release, another physics
]
docs = [
    "mkdocs>=1.6,<2",  # docs/ as a site; its hooks may change with 2
    "mkdocs-material>=9.5,<10",  # search, navigation and code blocks without a script or font from elsewhere
    "mkdocstrings[python]>=0.26,<2",  # the Python reference, from the docstrings
]

setup(
    name=NAME,
    version=ABOUT.findtext("version"),
    description=ABOUT.findtext("description"),
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    maintainer=ABOUT.findtext("maintainer"),
    maintainer_email=ABOUT.find("maintainer").get("email"),
    license=ABOUT.findtext("license"),
    url=ABOUT.findtext("url"),
    keywords="superquadrics depth-image robotics perception ros2 grasping pose-estimation shape-recovery",
    python_requires=">=3.10",
    packages=[
        "sq_perception",
        *(f"sq_perception.{name}" for name in SUBPACKAGES),
        "sq_perception.config",
        "sq_perception.weights",
        "sq_msgs_py",
    ],
    package_dir={"sq_perception.config": "config"},
    package_data={
        "sq_perception.config": ["*.rviz", "*.xml", "*.yaml"],
        "sq_perception.learning": ["configurations/*.yaml"],
        "sq_perception.recordings": ["*.html", "*.json"],
        "sq_perception.weights": ["*.safetensors", "*.json", "*.md"],
        "sq_perception": ["py.typed"],
        "sq_msgs_py": ["py.typed"],
    },
    data_files=share,
    zip_safe=False,
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",  # special functions, hulls, small linear algebra
        "numba>=0.60",  # ray casting and residuals, compiled
        "opencv-python-headless>=4.8",  # images and contours
        "trimesh>=4.6",  # meshes and GLB
        "safetensors>=0.4",  # weights that cannot carry code
        "array-api-compat>=1.9",  # one geometry for NumPy and torch
        "threadpoolctl>=3",  # keeps BLAS from threading products of 2000 x 3, which took the second core from the fits
        "pyyaml>=6",  # camera_info files, training configurations
        "matplotlib>=3.7",  # pictures
        "pillow>=9.1",  # sizes of images before OpenCV decodes them; Matplotlib brings it anyway
        "rich>=13",  # bars of progress
    ],
    extras_require={
        # Never among the requirements: they would shadow the rclpy of a ROS installation.
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        # What sq_msgs is built with where there is no ROS installation.
        "interfaces": [
            f"ros-jazzy-{name}"
            for name in (
                *("ament-cmake", "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-pytest", "ament-cmake-ros"),
                *("ament-cmake-include-directories", "ament-package", "python-cmake-module"),
                *("rosidl-core-generators", "rosidl-default-generators"),
            )
        ],
        "bags": bags,
        "exr": exr,
        "train": train,
        "picking": picking,
        "docs": docs,
        "test": [
            "torch==2.13.0",  # one release for all tests; after `train` pip would fetch the newest one first
            *bags,
            *exr,
            *train,
            *picking,
            *docs,
            "pytest>=7,<8.4",  # later ones break the launch_testing plugins of a ROS installation
            "hypothesis>=6",
            "jsonschema>=4.18",  # what recover writes against its schema
            "mcap-ros2-support>=0.5",  # reads bags independently of the code that wrote them
            "ruff>=0.6",
            "mypy>=1.11",
            "types-PyYAML",
            "setuptools>=68,<80",  # later ones are refused by colcon-core
            "wheel",
            "colcon-core",
            "colcon-ros",
            "colcon-python-setup-py",
            "colcon-package-information",
            "colcon-metadata",
            "colcon-library-path",
            "colcon-recursive-crawl",
            "colcon-test-result",
        ],
    },
    entry_points={
        "console_scripts": [
            "sq-perception = sq_perception.commands.main:main",
            *(f"{node} = sq_perception.nodes.executables:{node}" for node in NODES),
        ],
    },
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in (10, 11, 12, 13)),
        "Topic :: Scientific/Engineering :: Image Processing",
        "Topic :: Scientific/Engineering :: Image Recognition",
    ],
)
