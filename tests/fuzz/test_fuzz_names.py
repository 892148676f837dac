"""Names of machines, joints, covariates and units that would be code, through every target of `ccnn export`."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import pytest
from blark.parse import parse_source_code
from hypothesis import example, given, strategies as st
from kinds import KINDS
from machines import known
from stand_ins import fields
from test_targets import STRICT

from ccnn_torch import export_model
from ccnn_torch.compensation import Compensator, save_model
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.mechanisms.mechanism_file import mechanism_text

pytestmark = pytest.mark.fuzz
CASES = 0
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]

TOKENS = [
    *("*/", "/*", "*", "/", "//", "(*", "*)", "(", ")", "\\", "\n", "\r\n", "\t", "\\\n", "??/", "??/\n", '"', "'"),
    *('"""', ";;", "\n;;\n", "{{", "}}", "{%", "%", "%s", "$(", "`", "<!--", "-->", "]]>", "<", ">", "&", "|", "#"),
    *("@", "=1+1", "\x00", "\x1b", "\x7f", "\x85", "\u2028", "\u202e", "\ufeff", "\uffff", "é", "Ω", "😀", "..", "../"),
    *("~", "_", "-", " ", "int f(void){}", "END_FUNCTION_BLOCK", "#include <x>", "a", "Z", "0", "x" * 130, "\\u002a"),
    *(".so x", "in", "[m]", "]("),
]
names = st.lists(st.one_of(st.sampled_from(TOKENS), st.text(max_size=3)), min_size=1, max_size=6).map("".join)
HALF = math.pi / 2
UR10 = [[0, HALF, 0.1273, 0], [-0.612, 0, 0, 0], [-0.5723, 0, 0, 0], [0, HALF, 0.163941, 0], [0, -HALF, 0.1157, 0]]
UR10.append([0, 0, 0.0922, 0])
CODE = "*/void __attribute__((constructor,weak))f(){for(;;);}/*"
WORSE = '*)??/\n*\\\n/";;\n(*<a>`|\x00\u202e../=1'


@cache
def models() -> tuple[Compensator, Compensator, SerialArm]:
    """With two covariates; and of an arm, whose links are identified."""
    made, arm = known("sliding arm").compensator(), known("sliding arm").mechanism
    return KINDS["covariates"](), made, arm


def exported(folder: Path, machine: str, joints: list[str], more: list[str], units: list[str]) -> dict[str, str]:
    """Texts of all targets by `target/file`, of a model whose names they are."""
    compensator, on_arm, arm = models()
    compensator.joints = tuple(Coordinate(name, "rad") for name in joints)
    compensator.covariates = tuple(Coordinate(*pair) for pair in zip(more, units, strict=True))
    about = fields() | {"mechanism": load_mechanism("five_bar").describe() | {"name": machine}}
    model = save_model(folder / "model", compensator, about, forms=("safetensors",))["safetensors"]
    keys = arm.recipe["keys"] | {"name": machine}
    assert on_arm.machine is not None
    on_arm.machine._mechanism = (SerialArm(**keys),)
    about = fields() | {"mechanism": arm.describe() | {"name": machine, "keys": keys}}
    links = save_model(folder / "links", on_arm, about, forms=("safetensors",))["safetensors"]
    found = {}
    # Files of numbers: of an arm of that name, as a file may have it, for motors of such names.
    turning = SerialArm(visible(machine), "standard", UR10)
    before = dict(zip((p.name for p in turning.geometry), turning.nominal.tolist(), strict=True))
    numbers, current = folder / "arm.yaml", folder / "calibration.json"
    numbers.write_text(mechanism_text(turning, before), encoding="utf-8")
    motor = {"id": 1, "drive_mode": 0, "homing_offset": 1, "range_min": 0, "range_max": 4095}
    current.write_text(json.dumps({name: motor for name in (*joints, *more, machine, *"abcdef")}), encoding="utf-8")
    orders = {"c99": model, "st": model, "linuxcnc": model, "table": model, "urdf": links, "ros2_control": model}
    for to, path in (orders | dict.fromkeys(("ur", "linuxcnc_hal", "lerobot"), numbers)).items():
        for name, file in export_model(path, to, folder / to, current=current if to == "lerobot" else None).items():
            assert file.parent == folder / to and re.fullmatch(r"\w+\.\w+|Makefile", file.name, re.ASCII)
            found[f"{to}/{name}"] = file.read_text(encoding="utf-8")
    return found


def code_of(text: str, folder: Path, compiler: str) -> str:
    """C without comments and blanks; the headers of a controller are empty ones."""
    for name in ("rtapi", "rtapi_app", "rtapi_math", "hal", "kinematics", "float", "stddef"):
        (folder / f"{name}.h").touch()
    words = [compiler, "-E", "-P", "-std=c99", "-x", "c", "-nostdinc", "-I", str(folder), "-"]
    return "".join(subprocess.run(words, input=text, capture_output=True, text=True, check=True).stdout.split())


@cache
def plain_names() -> dict[str, str]:
    with TemporaryDirectory() as folder:
        return exported(Path(folder), "arm", ["q1", "q2"], ["time", "temperature"], ["s", "K"])


@given(
    machine=names,
    joints=st.lists(names, min_size=2, max_size=2, unique=True),
    more=st.lists(names, min_size=2, max_size=2, unique=True),
    units=st.lists(names, min_size=2, max_size=2),
)
@example(CODE + WORSE, ["=a*/b", "../../x"], [f"*){CODE}{WORSE}", "a_b"], [WORSE, "N*m/(m^2*K)"])
def test_names_are_never_code(fresh: Any, machine: str, joints: list[str], more: list[str], units: list[str]) -> None:
    wanted = plain_names()
    with fresh() as folder:
        try:
            found = exported(folder, machine, joints, more, units)
        except InputError:
            # Two inputs of one name.
            assert {*joints} & {*more}
            return
        for name in ("c99/selftest.c", "c99/Makefile", "c99/compensator.c", "ros2_control/compensator.c"):
            assert found[name] == wanted[name]
        for name in ("package.xml", "plugin.xml", "controllers.yaml", "CMakeLists.txt"):
            assert found[f"ros2_control/{name}"] == wanted[f"ros2_control/{name}"]
        controller, plain = (text["ros2_control/compensation.cpp"].partition("*/") for text in (found, wanted))
        assert controller[2] == plain[2] and controller[0].count("/*") == 1
        for compiler in COMPILERS:
            sources = [str(folder / "c99" / name) for name in ("selftest.c", "compensator.c")]
            subprocess.run([compiler, *STRICT, "-fsyntax-only", *sources], check=True)
            header = "c99/compensator.h"
            assert code_of(found[header], folder, compiler) == code_of(wanted[header], folder, compiler)
        structured(found["st/compensator.st"], wanted["st/compensator.st"])
        component(found["linuxcnc/ccnnkins.comp"], wanted["linuxcnc/ccnnkins.comp"], folder)
        header, *rows = csv.reader(found["table/table.csv"].splitlines())
        assert len(header) == 4 and {len(row) for row in rows} == {4} and not {h[0] for h in header} & {*"=+-@\t"}
        for name in ("ur/kinematics.yaml", "linuxcnc_hal/kinematics.hal"):
            assert found[name] == wanted[name]
        assert [*json.loads(found["lerobot/calibration.json"])][:4] == [*dict.fromkeys((*joints, *more, machine))][:4]
        for text in (value for name, value in found.items() if name.endswith(".md")):
            assert "<" not in text and text.isprintable() is False and text.isascii()
            assert all(line.count("`") % 2 == 0 and line.count("|") in (0, 4, 6) for line in text.splitlines())
        for name, key in (("robot.urdf", "name"), ("robot.xml", "model")):
            tree = ElementTree.fromstring(found[f"urdf/{name}"])
            assert tree.get(key) == parse_yaml(found["urdf/robot.yaml"], "robot.yaml")["robot"]
            other = ElementTree.fromstring(wanted[f"urdf/{name}"])
            assert [e.tag for e in tree.iter()] == [e.tag for e in other.iter()]


def structured(text: str, wanted: str) -> None:
    """One comment, which a parser takes for one, and then what stands there under plain names."""
    at = wanted.index("FUNCTION_BLOCK ")
    assert text.endswith(wanted[at:])
    head = text[: len(text) - len(wanted[at:])].rstrip()
    assert head.count("(*") == head.count("*)") == 1 and head.endswith("*)") and head.isascii()
    assert len(parse_source_code(f"{head}\nFUNCTION_BLOCK a\nEND_FUNCTION_BLOCK").transform().items) == 1


def component(text: str, wanted: str, folder: Path) -> None:
    """Pins of other names, and the same code but for these."""
    (about, code), (plain, same) = (part.split("\n;;\n") for part in (text, wanted))
    pins, named = (re.findall(r"^pin in float (\w+) ", part, re.MULTILINE) for part in (about, plain))
    line = re.compile(r'pin in float in_[A-Za-z0-9_]{1,30} "Covariate [ -~]*";')
    assert len({pin.replace("_", "-").rstrip("-") for pin in pins}) == len(pins) == len(named)
    assert not {*"\\"} & {*about} and about.count('"') == plain.count('"')
    rest, other = ([row for row in part.splitlines() if "pin in float" not in row] for part in (about, plain))
    assert rest == other and sum(line.fullmatch(row) is not None for row in about.splitlines()) == len(pins)
    for k, (new, old) in enumerate(zip(pins, named, strict=True)):
        code = code.replace(f"ccnn_covariates[{k}] = {new};", f"ccnn_covariates[{k}] = {old};")
    for compiler in COMPILERS:
        assert code_of(code, folder, compiler) == code_of(same, folder, compiler)
