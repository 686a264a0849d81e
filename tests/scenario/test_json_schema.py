import json
import tomllib
from pathlib import Path

from estbench.scenario.files import bundled
from estbench.scenario.json_schema import json_schema
from estbench.scenario.schema import Scenario

ROOT = Path(__file__).parents[2]


def test_the_committed_schema_is_that_of_the_code():
    """Made by `estbench schema --out assets/scenario.schema.json`."""
    assert (ROOT / "assets" / "scenario.schema.json").read_text("utf-8") == json_schema()


def test_every_scenario_names_it():
    files = [*bundled().values(), *(ROOT / "examples").rglob("*.toml")]
    files = [file for file in files if file.name != "pyproject.toml"]
    assert len(files) > 15
    for file in files:
        first = file.read_text("utf-8").splitlines()[0]
        assert first.startswith("#:schema "), file
        assert (file.parent / first.removeprefix("#:schema ")).is_file(), file


def test_it_knows_the_keys_and_no_null():
    schema = json.loads(json_schema())
    assert schema["properties"].keys() == Scenario.model_fields.keys()
    assert schema["required"] == ["name", "model"]
    assert '"null"' not in json_schema()
    assert schema["$defs"]["ChannelSection"]["properties"]["rate"]["exclusiveMinimum"] == 0
    assert schema["additionalProperties"] is False
    given = tomllib.loads(bundled()["cartpole"].read_text("utf-8"))
    assert given.keys() <= schema["properties"].keys()
