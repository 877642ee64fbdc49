from setuptools import setup

package = "quadvel_sim"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["sim_node = quadvel_sim.sim_node:main"]},
    license="Apache-2.0",
    description="The stand-in robot: an AlienGo in MuJoCo behind its low-level topics.",
)
