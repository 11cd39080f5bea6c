"""Package definition for colcon."""

from setuptools import setup

NAME = "sceneprint_ros"

setup(
    name=NAME,
    version="1.0.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/relocaliser.launch.py", "launch/nav2.launch.py"]),
        (f"share/{NAME}/config", ["config/relocaliser.yaml"]),
    ],
    install_requires=["setuptools"],  # rosdep does not know sceneprint-client; see README.md
    zip_safe=True,
    maintainer="sceneprint maintainers",
    maintainer_email="maintainers@sceneprint.example",
    description="Localises a robot in a sceneprint map",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"relocaliser = {NAME}.relocaliser_node:main"]},
)
