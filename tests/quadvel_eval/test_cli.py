from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import attrs
import pytest

from quadvel_description.network_file import NetworkFileError
from quadvel_eval import bench
from quadvel_eval.cli import bench_command, eval_command

QUADVEL = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()")


def test_a_missing_policy_fails_with_its_name_before_any_output(tmp_path: Path) -> None:
    with pytest.raises(NetworkFileError, match=r"nowhere\.onnx: no such file"):
        eval_command(tmp_path / "out", "quick", policy=tmp_path / "nowhere.onnx")
    assert not any(tmp_path.iterdir())


def test_a_file_in_place_of_the_folder_fails(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(NotADirectoryError, match="is a file"):
        eval_command("quick", tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_an_unknown_grid_ends_in_a_sentence_and_no_traceback(tmp_path: Path) -> None:
    command = [*QUADVEL, "eval", "--grid", "huge", "--out", str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2
    assert "'huge'" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_ctrl_c_twice_ends_an_evaluation_and_leaves_the_old_results(tmp_path: Path) -> None:
    (tmp_path / "eval.json").write_text("old")
    command = [*QUADVEL, "eval", "--grid", "paper", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, text=True)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    until = time.monotonic() + 60.0
    while len(children.read_text().split()) < 2 and time.monotonic() < until:  # workers, and their tracker
        time.sleep(0.1)
    time.sleep(0.5)
    assert process.poll() is None, "it ended before it was asked to"
    for _ in range(2):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(0.1)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT
    assert "Traceback" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["eval.json"]
    assert (tmp_path / "eval.json").read_text() == "old"


def test_bench_fails_before_it_measures_if_it_cannot_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = bench.Benchmark(lambda: pytest.fail("it measured"), ())
    monkeypatch.setattr(bench, "PARTS", {"simulator": measure})
    for out in (tmp_path, Path("/proc/bench.json")):
        with pytest.raises(OSError, match=r"is a folder, expected a file|can't be written"):
            bench_command(out)


@pytest.mark.parametrize("options", [{"seconds": 5.0}, {"busy": 3}])
def test_options_of_the_live_bench_are_refused_without_it(tmp_path: Path, options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="belongs to --live"):
        bench_command(tmp_path / "bench.json", **options)  # type: ignore[arg-type]


def test_bench_writes_figures_and_reports_skipped_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = {
        name: attrs.evolve(part, measure=lambda: {"skipped": "not now"}) for name, part in bench.PARTS.items()
    }
    figures = {"realtime_factor": 17.25, "with_sensors_realtime_factor": 9.0}
    parts["simulator"] = attrs.evolve(parts["simulator"], measure=lambda: figures)
    monkeypatch.setattr(bench, "PARTS", parts)
    added = [
        EntryPoint(f"added{k}", f"{module}:PART", bench.GROUP)
        for k, module in enumerate(("tiny", "not_here"))
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda group: added if group == bench.GROUP else [])
    tiny = SimpleNamespace(PART=bench.Benchmark(lambda: {"speed": 3.25}, (("speed", "tiny speed", "1"),)))
    monkeypatch.setitem(sys.modules, "tiny", tiny)  # type: ignore[arg-type]
    bench_command(tmp_path / "out" / "bench.json")
    written = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert written["simulator"]["realtime_factor"] == 17.25
    assert written["policy"] == {"skipped": "not now"}
    assert written["added0"] == {"speed": 3.25}
    assert "not_here" in written["added1"]["skipped"]
    assert written["machine"]["cores"] >= 1
    said = capsys.readouterr().out
    assert "17.25" in said
    assert "not now" in said
    assert "tiny speed" in said


def test_the_benchmarks_of_the_training_can_be_loaded() -> None:
    pytest.importorskip("torch")
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    for name, value in project["entry-points"][bench.GROUP].items():
        assert isinstance(EntryPoint(name, value, bench.GROUP).load(), bench.Benchmark)
