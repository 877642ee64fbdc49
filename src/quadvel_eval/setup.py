from setuptools import setup

package = "quadvel_eval"

setup(
    name=package,
    version="0.1.0",
    packages=[package],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    license="Apache-2.0",
    description="Evaluation in one process, faster than real time; reports, scripted planner, benchmark.",
    entry_points={"console_scripts": ["planner = quadvel_eval.scripted_planner:main"]},
)
