"""Files of a report: complete, self-contained, and written all together."""

from __future__ import annotations

import copy
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorParameters
from quadvel_sysid.report.identification import Identification, Shape, Trace
from quadvel_sysid.report.report import REPORT_FILES, write_report
from tests.helpers.robots import ALIENGO

JOINTS = ["FR_hip_joint", "FR_thigh_joint", "FR_calf_joint"]
DECISION = "Add stribeck_friction & a bound: the held-out error falls from 0.31 to 0.07 <N m>²."
REPORT: dict[str, Any] = {
    "schema": 1,
    "joints": JOINTS,
    "units": {"mse": "N² m²"},
    "noise_floor": 0.066,
    "reference_gains": {"kp": 30.0, "kd": 0.5, "commanded": True},
    "pd": {"train_mse": 0.8, "heldout_mse": 0.82},
    "baselines": {"joint_pd": {"heldout_mse": 2.5}, "ridge": {"heldout_mse": 1.5}},
    "before": {
        "train_mse": 0.3,
        "heldout_mse": 0.31,
        "per_joint": [0.2, 0.3, 0.43],
        "delta_kp": -0.7,
        "delta_kd": -0.02,
        "input_delay_ms": 7.05,
        "output_delay_ms": 1.1,
    },
    "after": {
        "train_mse": 0.068,
        "heldout_mse": 0.07,
        "per_joint": [0.07, 0.068, 0.072],
        "delta_kp": [-0.71, -0.72, -0.73],
        "delta_kp_ci95": [[-0.74, -0.68], [-0.75, -0.69], [-0.76, -0.7]],
        "input_delay_ms": 7.01,
        "input_delay_ms_ci95": [6.95, 7.07],
    },
    "effects": [
        {
            "name": "stribeck_friction",
            "joints": JOINTS,
            "params": {"c": {"value": 0.4, "ci95": [0.38, 0.43], "unit": "N m"}},
            "indistinguishable": ["coulomb_friction"],
            "separated_by": "slow motion around standstill",
            "heldout_gain": 0.2,
            "p_value": 1e-9,
        },
        {
            "name": "learned_residual",
            "joints": ["FR_calf_joint"],
            "params": {},
            "terms": [
                {
                    "kind": "smooth",
                    "inputs": ["FR_thigh_joint/dq"],
                    "joints": ["FR_calf_joint"],
                    "heldout_gain": 0.04,
                }
            ],
            "inputs": ["FR_thigh_joint/dq"],
            "indistinguishable": [],
            "heldout_gain": 0.04,
            "p_value": 0.001,
        },
    ],
    "rejected": [{"name": "backlash", "selecting_gain": -0.001, "reason": "no gain on held-out blocks"}],
    "unexplained": {
        "verdict": "structured",
        "fraction": 0.016,
        "depends_on": ["FR_thigh_joint/dq"],
        "joints": ["FR_calf_joint"],
    },
    "decision": DECISION,
    "findings": [
        {
            "log": "logs/walk.mcap",
            "kind": "warning",
            "field": "t",
            "joints": [],
            "text": "2 gaps of 30 ms <here>",
        }
    ],
    "warnings": ["stribeck_friction.c is at its bound"],
    "withheld": [],
}


def identification(**changes: Any) -> Identification:
    rng = np.random.default_rng(1)
    t = np.concatenate([np.arange(0.0, 1.0, 0.001), np.arange(3.0, 4.0, 0.001)])
    speed = 5 * np.cos(9 * t)
    noise, friction = 0.26 * rng.standard_normal(len(t)), -0.4 * np.tanh(speed / 0.1)
    after = 6 * np.sin(9 * t)
    measured = after + friction + noise
    measured[50:60] = np.nan
    trace = Trace(t=t, measured=measured, pd=after * 1.2, before=after, after=after + friction)
    shape = Shape(
        effect="stribeck_friction",
        joint=JOINTS[2],
        signal="dq",
        unit="rad/s",
        x=speed,
        before=friction + noise,
        after=noise,
    )
    return Identification(
        {**copy.deepcopy(REPORT), **changes},
        ActuatorParameters.of(ALIENGO),
        {JOINTS[2]: trace},
        (shape,),
    )


class Page(HTMLParser):
    """Checks that tags close, and collects the text and the resources that the page loads."""

    VOID = ("meta", "br", "img", "hr")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.loaded: list[str] = []
        self.ids: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attributes:
            if name == "id" and value:
                self.ids.append(value)
            if name in ("src", "href", "xlink:href") and value and not value.startswith(("#", "data:")):
                self.loaded.append(value)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report") / "new"
    write_report(identification(), out)
    return out


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    return Page((folder / "report.html").read_text())


def test_three_files_are_written_and_nothing_else(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == sorted(REPORT_FILES)


def test_the_json_is_the_report_and_the_yaml_the_model(folder: Path) -> None:
    assert json.loads((folder / "report.json").read_text()) == REPORT
    assert ActuatorParameters.load(ALIENGO, folder / "actuator.yaml") == ActuatorParameters.of(ALIENGO)


def test_the_page_is_well_formed_and_loads_nothing(page: Page) -> None:
    assert page.open == []
    assert page.loaded == []
    assert len(page.ids) == len(set(page.ids))


def test_the_page_starts_with_the_decision_and_shows_its_evidence(page: Page) -> None:
    text = page.text
    assert DECISION in text
    order = [
        "joint by joint",
        "Measured and predicted",
        "depends on",
        "Candidates",
        "Parameters",
        "What to record next",
    ]
    places = [text.index(DECISION), *(text.index(title) for title in order)]
    assert places == sorted(places)
    words = [
        *("backlash", "no gain on held-out blocks", "0.38 … 0.43", "-0.76 … -0.7", "6.95 … 7.07"),
        *("2 gaps of 30 ms <here>", "stribeck_friction.c is at its bound", "structured", "smooth"),
    ]
    for word in words:
        assert word in text


def test_indistinguishable_effects_are_listed_with_a_distinguishing_motion(page: Page) -> None:
    assert (
        "To distinguish stribeck_friction from coulomb_friction, record slow motion around standstill"
        in page.text
    )
    assert "stribeck_friction, coulomb_friction" in page.text
    assert "quadvel excite creep --seconds 40" in page.text
    assert "quadvel excite solo" in page.text


def test_a_second_write_gives_the_same_bytes_and_keeps_other_files(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    write_report(identification(), tmp_path)
    assert (tmp_path / "report.html").read_bytes() == (folder / "report.html").read_bytes()
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_failed_write_keeps_the_former_report(folder: Path) -> None:
    former = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_report(identification(noise_floor=float("nan")), folder)
    with pytest.raises(KeyError):
        write_report(attrs.evolve(identification(), report={"schema": 1}), folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == former


def test_a_report_without_effects_states_that(tmp_path: Path) -> None:
    white = {"verdict": "white", "fraction": 0.0, "depends_on": [], "joints": []}
    bare = identification(effects=[], rejected=[], unexplained=white, decision="Nothing significant.")
    write_report(attrs.evolve(bare, shapes=(), traces={}), tmp_path)
    text = Page((tmp_path / "report.html").read_text()).text
    for sentence in (
        "Nothing significant.",
        "No candidate was tried.",
        "No question is open",
    ):
        assert sentence in text


def test_a_withheld_model_is_not_written_unless_forced(tmp_path: Path) -> None:
    plain = attrs.evolve(identification(), shapes=(), traces={})  # without pictures
    withheld = attrs.evolve(plain, report={**plain.report, "withheld": ["kp is 0"]})
    write_report(plain, tmp_path)
    assert write_report(withheld, tmp_path) == ("report.html", "report.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "report.json"]
    assert write_report(withheld, tmp_path, force=True) == REPORT_FILES
