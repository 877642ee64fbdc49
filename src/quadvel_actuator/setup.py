from setuptools import find_packages, setup

package = "quadvel_actuator"

setup(
    name=package,
    version="0.1.0",
    packages=find_packages(),
    package_data={package: ["data/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    entry_points={"console_scripts": [f"identify = {package}.identify.cli:main"]},
    license="Apache-2.0",
    description="How the joints answer: the empirical actuator model, and what measured logs say it lacks.",
)
