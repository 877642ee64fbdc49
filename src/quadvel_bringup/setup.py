from setuptools import setup

package = "quadvel_bringup"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    package_data={package: ["config/*", "config/plants/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", ["launch/sim.launch.py"]),
        (f"share/{package}/config", [f"{package}/config/params.yaml", f"{package}/config/robot.rviz"]),
    ],
    entry_points={"console_scripts": ["quadvel = quadvel_bringup.__main__:main"]},
    license="Apache-2.0",
    description="Starts the nodes together: launch files, parameters and the `quadvel` command line.",
)
