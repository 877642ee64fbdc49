from setuptools import setup

package = "quadvel_dds"

setup(
    name=package,
    version="0.1.0",
    packages=[package, f"{package}.rclpy", f"{package}.rclpy.impl"],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    license="Apache-2.0",
    description="The part of rclpy that quadvel's nodes use, over Cyclone DDS: the default without ROS 2.",
)
