from setuptools import setup

package = "quadvel_description"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/urdf", ["urdf/aliengo.urdf"]),
    ],
    license="Apache-2.0",
    description="The Unitree AlienGo: joint table, limits, postures, kinematics, MJCF and URDF.",
)
