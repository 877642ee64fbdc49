from setuptools import setup

package = "quadvel_policy"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    package_data={package: ["policies/*.onnx"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    license="Apache-2.0",
    description="Observation, action, policy file, modes and their safety, command mux, and the nodes.",
    entry_points={
        "console_scripts": [
            "controller = quadvel_policy.controller:main",
            "command_mux = quadvel_policy.command_mux_node:main",
        ]
    },
)
