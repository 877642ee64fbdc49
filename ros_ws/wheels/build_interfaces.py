"""Builds quadvel's interfaces for the rclpy of this Python environment, which comes from PyPI, and installs them there.

ROS 2 Jazzy's rclpy and standard messages are wheels; `quadvel_msgs`, and `tf2_msgs` which has no wheel, have to be
generated with the wheels' rosidl and compiled, for Fast DDS, the only middleware among the wheels. What was built is
kept as a wheel below $XDG_CACHE_HOME/quadvel/interfaces (~/.cache without it), under a hash of all it is made from.

`make ros` runs this with the Python of `.venv-ros`. Not for a ROS 2 installation: there colcon builds the interfaces.
"""

from __future__ import annotations

import base64
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from importlib import metadata
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent
PACKAGES = {"quadvel_msgs": HERE.parents[1] / "src" / "quadvel_msgs", "tf2_msgs": HERE / "tf2_msgs"}
"""The folder of each package, with its definitions in `msg` and `srv`."""
VERSION = "0.1.0"
PYTHONS = ((3, 11), (3, 13))
"""The first and the last Python that both quadvel and the wheels support."""
PREFIX = Path(sys.prefix)
STRUCTURES = "rosidl_generator_c"
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""How Fast DDS reads and writes a message, and how it describes its type to others."""
RUNTIME = (
    "rosidl_runtime_c", "rosidl_typesupport_c", *TYPE_SUPPORTS, "rosidl_typesupport_fastrtps_cpp",
    "rosidl_dynamic_typesupport", "rmw", "rcutils", "fastcdr",
)  # fmt: skip


def main() -> None:
    """Install the interfaces, out of the cache if they were built before; with --check look whether that can be."""
    if fault := platform_fault():
        sys.exit(fault)
    if "--check" in sys.argv[1:]:
        return
    release = f"quadvel_interfaces-{VERSION}+{fingerprint()}"
    wheel = cache_folder() / f"{release}-{tag()}.whl"
    if not wheel.exists():
        print("Building quadvel_msgs and tf2_msgs for rclpy (under a minute, once) ...", flush=True)
        wheel.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory() as folder:
            for name in PACKAGES:
                build(name, Path(folder), release)
            unfinished = wheel.with_suffix(f".{os.getpid()}")
            pack(Path(folder) / "wheel", release, unfinished)
        unfinished.replace(wheel)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*pip, str(wheel)], check=True)


def platform_fault() -> str | None:
    """Why the wheels of rclpy do not run here, in a sentence, or None if they do."""
    here = f"{platform.python_implementation()} {platform.python_version()} on {platform.system()} {platform.machine()}"
    fits = PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1] and platform.python_implementation() == "CPython"
    if not fits or (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return (
            f"rclpy comes as wheels for CPython 3.11 to 3.13 on Linux x86_64 alone, and this is {here}: "
            "install ROS 2 Jazzy, or stay with quadvel's embedded middleware (make setup)"
        )
    headers = Path(sysconfig.get_path("include")) / "Python.h"
    missing = [name for name in ("gcc", "g++") if shutil.which(name) is None]
    missing += [] if headers.exists() else [str(headers)]
    if missing:
        return f"building quadvel's interfaces for rclpy needs {' and '.join(missing)}: apt install g++ python3-dev"
    return None


def cache_folder() -> Path:
    """Where built wheels are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "quadvel" / "interfaces"


def fingerprint() -> str:
    """Of everything that the built interfaces depend on: definitions, this script, Python, versions of the wheels."""
    digest = hashlib.sha256(sys.version.encode())
    for file in [Path(__file__), *(file for name in PACKAGES for file in definitions(name))]:
        digest.update(f"\n{file.name}\n".encode() + file.read_bytes())
    found = {f"{d.metadata['Name']}=={d.version}" for d in metadata.distributions()}
    digest.update("\n".join(sorted(text for text in found if text.startswith(("ros-", "numpy=")))).encode())
    return digest.hexdigest()[:16]


def tag() -> str:
    """Which Python and which platform a wheel is for."""
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    return f"{python}-{python}-linux_x86_64"


def definitions(name: str) -> list[Path]:
    """The files of a package's messages and services."""
    return sorted([*PACKAGES[name].glob("msg/*.msg"), *PACKAGES[name].glob("srv/*.srv")])


def build(name: str, folder: Path, release: str) -> None:
    """Generate and compile one package into `folder`/wheel: Python in `name`, libraries where rclpy looks for them."""
    work, wheel = folder / name, folder / "wheel"
    with redirect_stdout(StringIO()):  # it names every file
        generate(name, work)
    python = wheel / name
    shutil.copytree(work / "py", python, ignore=shutil.ignore_patterns("*.c"))
    (python / "__init__.py").touch()
    libraries = wheel / f"{release}.data" / "data" / "lib"
    libraries.mkdir(parents=True, exist_ok=True)
    objects = compile_all(name, work)
    structures = libraries / f"lib{name}__{STRUCTURES}.so"
    link(name, structures, objects[STRUCTURES], libraries, [STRUCTURES])
    for part in TYPE_SUPPORTS:
        link(
            name,
            libraries / f"lib{name}__{part}.so",
            objects[part],
            libraries,
            [STRUCTURES, part],
            structures,
        )
    extension = python / f"{name}_s__rosidl_typesupport_c.so"
    parts = [STRUCTURES, "rosidl_generator_py", "rosidl_typesupport_c"]
    link(name, extension, objects["rosidl_typesupport_c"] + objects["py"], libraries, parts, structures)


def generate(name: str, work: Path) -> None:
    """Write the sources of a package: C and C++ in folders of `work` named after their library, Python in `work`/py.

    rosidl's own command line would do this too, but every plug-in of the wheels is registered twice, which it refuses.
    """
    os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)  # where rosidl looks for its templates
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_adapter.srv import convert_srv_to_idl
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    idl, files = work / "idl", []
    for file in definitions(name):
        convert = convert_msg_to_idl if file.suffix == ".msg" else convert_srv_to_idl
        relative = Path(file.parent.name, file.name)
        convert(PACKAGES[name], name, relative, idl / relative.parent)
        files.append(f"{idl}:{relative.with_suffix('.idl')}")
    share = [str(PREFIX / "share")]
    hashes = HashTypeDescription("").generate_type_hashes(name, files, share, work / "hashes")
    GenerateC("").generate(name, files, share, work / STRUCTURES, hashes)
    supports = {
        TYPE_SUPPORTS[0]: GenerateFastRTPSCTypesupport(""),
        TYPE_SUPPORTS[1]: GenerateIntrospectionCTypesupport(""),
        "rosidl_typesupport_c": GenerateCTypesupport("", typesupport_implementations=list(TYPE_SUPPORTS)),
        "py": GeneratePython("", typesupport_implementations=["rosidl_typesupport_c"]),
    }
    for part, generator in supports.items():
        generator.generate(name, files, share, work / part)


def compile_all(name: str, work: Path) -> dict[str, list[str]]:
    """Compile all sources of a package, side by side; returns the object files by their folder in `work`."""
    flags = ["-O2", "-fPIC", "-w", *(f"-I{folder}" for folder in include_folders(name, work))]
    sources = sorted([*work.rglob("*.c"), *work.rglob("*.cpp")])

    def compile_one(source: Path) -> None:
        compiler = ["g++", "-std=c++17"] if source.suffix == ".cpp" else ["gcc", "-std=gnu11"]
        run([*compiler, *flags, "-c", str(source), "-o", f"{source}.o"])

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(compile_one, sources))
    return {folder.name: [str(file) for file in sorted(folder.rglob("*.o"))] for folder in work.iterdir()}


def link(
    name: str, target: Path, objects: list[str], folder: Path, parts: list[str], own: Path | None = None
) -> None:
    """Link a library against `parts` of the packages used, those of ROS 2's runtime, and `own` of this package."""
    libraries = [f"-l{package}__{part}" for package in used_packages(name) for part in parts]
    libraries += [f"-l{library}" for library in RUNTIME]
    libraries += [str(own)] if own else []
    shared = [
        "g++",
        "-shared",
        f"-Wl,-soname,{target.name}",
        "-Wl,--allow-shlib-undefined",
        "-o",
        str(target),
    ]
    # The wheels of ROS 2 start Python with lib/ among the places where libraries are looked for.
    run([*shared, *objects, f"-L{PREFIX / 'lib'}", f"-L{folder}", *libraries])


def include_folders(name: str, work: Path) -> Iterator[Path]:
    """Where headers lie; the generated ones include each other as `PACKAGE/msg/...`."""
    import numpy

    for part in (STRUCTURES, *TYPE_SUPPORTS, "rosidl_typesupport_c"):
        folder = work / f"include_{part}"
        folder.mkdir()
        (folder / name).symlink_to(work / part)
        yield folder
    yield PREFIX / "include"
    yield from (folder for folder in sorted((PREFIX / "include").iterdir()) if folder.is_dir())
    yield Path(sysconfig.get_path("include"))
    yield Path(numpy.get_include())


def used_packages(name: str) -> list[str]:
    """The packages whose messages a package uses, and those that its services bring."""
    text = "\n".join(file.read_text() for file in definitions(name))
    used = {*re.findall(r"^(\w+)/\w+", text, re.MULTILINE), "builtin_interfaces"}
    return sorted(used | ({"service_msgs"} if (PACKAGES[name] / "srv").is_dir() else set()))


def run(command: list[str]) -> None:
    """Run a compiler; ends the program with what it wrote if it fails."""
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\nfailed:\n{done.stderr}")


def pack(folder: Path, release: str, wheel: Path) -> None:
    """Write what lies in `folder` as the wheel of a release ("NAME-VERSION")."""
    info = f"{release}.dist-info"
    files = {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }
    title, version = release.split("-")
    files[f"{info}/METADATA"] = f"Metadata-Version: 2.1\nName: {title}\nVersion: {version}\n".encode()
    files[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: quadvel\nRoot-Is-Purelib: false\nTag: {tag()}\n".encode()
    )
    lines = [f"{name},sha256={checksum(content)},{len(content)}" for name, content in files.items()]
    files[f"{info}/RECORD"] = "\n".join([*lines, f"{info}/RECORD,,", ""]).encode()
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def checksum(content: bytes) -> str:
    """As RECORD of a wheel wants it."""
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


if __name__ == "__main__":
    main()
