"""All packages as one pip distribution. Each folder in src/ is set up on its own by colcon."""

from pathlib import Path

from setuptools import find_packages, setup

package_dir = {}
for folder in [*sorted(Path("src").glob("quadvel_*")), Path("training")]:
    for package in find_packages(str(folder)):
        package_dir[package] = str(folder / Path(*package.split(".")))
# The definitions of our own messages are data that recordings and the embedded middleware are read with.
package_dir["quadvel_recordings.interfaces"] = "src/quadvel_msgs"

setup(packages=sorted(package_dir), package_dir=package_dir)
