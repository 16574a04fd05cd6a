from glob import glob

from setuptools import setup

PACKAGE = "sgc_ros"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=[PACKAGE],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The SGC authors",
    maintainer_email="maintainers@sgc.example",
    description="Starts a node of SGC (secure global connectivity for ROS 2) by a launch file.",
    license="Apache-2.0",
)
