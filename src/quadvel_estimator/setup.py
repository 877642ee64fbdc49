from setuptools import setup

package = "quadvel_estimator"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    package_data={package: ["models/*.onnx"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    license="Apache-2.0",
    description="Linear velocity of the trunk: a learned estimator and a contact-aided Kalman filter.",
    entry_points={"console_scripts": ["estimator = quadvel_estimator.estimator:main"]},
)
