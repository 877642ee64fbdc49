from setuptools import setup

package = "quadvel_nodes"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    license="Apache-2.0",
    description="What every node stands on: messages to records and back, parameters, diagnostics, ticks.",
)
