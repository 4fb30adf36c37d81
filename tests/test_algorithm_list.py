"""The list of algorithms: what help and documentation are written from."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import newton_qd.compat
from newton_qd import cli
from newton_qd.qd.algorithms import ALGORITHMS, AlgorithmSpec
from newton_qd.qd.algorithms.dcrl_me import DCRLMEOptions
from newton_qd.qd.algorithms.me_es import MEESOptions
from newton_qd.qd.algorithms.options import option_texts
from newton_qd.qd.algorithms.pga_me import PGAMEOptions

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("spec", ALGORITHMS, ids=lambda spec: spec.name)
def test_every_option_has_a_meaning(
    spec: AlgorithmSpec[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["algorithms", spec.name]) == cli.OK
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.startswith(f"{spec.name}: {spec.summary.replace('`', '')}")
    fields = {field.name: field for field in dataclasses.fields(spec.options)}
    rows = option_texts(spec.options)
    assert {name for name, _, _ in rows} == set(fields)
    for name, default, meaning in rows:
        assert meaning.endswith("."), f"{name} is not described"
        head = f"{name}={default}" if default else name
        assert f" {head} {meaning.replace('``', '')}" in printed
    for env_name, tuned in spec.tuned.items():
        assert tuned and set(tuned) <= set(fields) and env_name in printed


def test_the_list_names_every_algorithm(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["algorithms"]) == cli.OK
    listed = capsys.readouterr().out
    names = [spec.name for spec in ALGORITHMS]
    assert [line.split()[0] for line in listed.splitlines() if line[2] != " "] == names
    with pytest.raises(SystemExit):
        cli.main(["evolve", "--help"])
    # a long list is wrapped, also at hyphens
    assert ",".join(names) in "".join(capsys.readouterr().out.split())
    assert cli.main(["algorithms", "ga"]) == cli.BAD_ARGUMENTS
    assert "'ga', which does not exist; allowed: me, cma-me," in capsys.readouterr().err


def test_options_of_qdax_are_those_of_qdax() -> None:
    newton_qd.compat.install()
    try:
        from qdax.core.emitters.dcrl_me_emitter import DCRLMEConfig
        from qdax.core.emitters.mees_emitter import MEESConfig
        from qdax.core.emitters.pga_me_emitter import PGAMEConfig
    finally:
        newton_qd.compat.uninstall()
    for own, theirs in (
        (PGAMEOptions, PGAMEConfig),
        (DCRLMEOptions, DCRLMEConfig),
        (MEESOptions, MEESConfig),
    ):
        ours = {field.name: field.default for field in dataclasses.fields(own)}
        original = {field.name: field.default for field in dataclasses.fields(theirs)}
        assert set(ours) == set(original)
        for name, default in ours.items():
            if name == "replay_buffer_size":
                assert default == 100_000
            elif default is not None:  # those follow from the run
                assert default == original[name], name


def test_the_list_is_light() -> None:
    code = (
        "import sys, newton_qd.qd.algorithms\n"
        "heavy = {'jax', 'warp', 'newton', 'qdax', 'flax'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
