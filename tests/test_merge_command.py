"""Commands that split and merge maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import protomark as pm
from conftest import protomark, random_descriptors


def test_split_and_merge(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(30) % 10, random_descriptors(30))
    scene.set_positions(np.arange(8), np.repeat(np.arange(8.0)[:, None], 3, axis=1))
    whole = tmp_path / "scene.pmk"
    scene.save(whole)
    facts_file = tmp_path / "facts.json"

    done = protomark("split", whole, "--parts", 3, "-o", tmp_path / "parts", "--json", facts_file)
    assert done.returncode == 0, done.stderr
    facts = json.loads(facts_file.read_text())
    assert [part["ids"] for part in facts["parts"]] == [[0, 2], [3, 5], [6, 9]]
    names = [f"scene.{i}.pmk" for i in range(3)]
    assert sorted(file.name for file in (tmp_path / "parts").glob("*.pmk")) == names
    assert "scene.1.pmk" in done.stdout
    parts = [tmp_path / "parts" / name for name in names]
    done = protomark("merge", *parts, "-o", tmp_path / "joined.pmk", "--json", facts_file)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "joined.pmk").read_bytes() == whole.read_bytes()
    facts = json.loads(facts_file.read_text())
    assert (facts["landmarks"], [one["in_common"] for one in facts["inputs"]]) == (10, [0, 0, 0])

    done = protomark("split", whole, "--cell-size", 4, "--sealed", "-o", tmp_path / "tiles")
    assert done.returncode == 0, done.stderr
    names = [f"scene.{cell}.sealed.pmk" for cell in ("0_0_0", "1_1_1", "nowhere")]
    assert sorted(file.name for file in (tmp_path / "tiles").glob("*.pmk")) == names
    tile = pm.open(tmp_path / "tiles" / names[1])
    assert isinstance(tile, pm.SealedMap)
    np.testing.assert_array_equal(tile.ids, [4, 5, 6, 7])
    # Parts of an earlier split go, but for what somebody put in the place of one.
    parts[1].write_bytes(whole.read_bytes())
    done = protomark("split", whole, "--parts", 1, "-o", tmp_path / "parts", "--json", facts_file)
    assert json.loads(facts_file.read_text())["removed"] == [str(parts[2])]
    assert "1 files of an earlier split were removed" in done.stdout + done.stderr
    assert [file.exists() for file in parts] == [True, True, False]
    assert protomark("split", whole, "--ids", "5", "-o", tmp_path / "parts").returncode == 0
    np.testing.assert_array_equal(pm.open(parts[0]).ids, np.arange(5))

    # The same landmarks under the same ids by accident, and otherwise.
    copy = tmp_path / "copy.pmk"
    copy.write_bytes(whole.read_bytes())
    done = protomark("merge", whole, copy, "-o", tmp_path / "joined.pmk")
    assert "10 of them in an earlier map" in done.stdout
    np.testing.assert_array_equal(pm.open(tmp_path / "joined.pmk").counts(0), [6])
    done = protomark("merge", whole, copy, "-o", tmp_path / "joined.pmk", "--renumber")
    assert done.returncode == 0, done.stderr
    joined = pm.open(tmp_path / "joined.pmk")
    np.testing.assert_array_equal(joined.ids, np.arange(20))
    np.testing.assert_array_equal(joined.prototypes(np.arange(10, 20)), scene.prototypes(scene.ids))


def test_maps_of_other_scenes_or_worlds_are_not_merged(encoder: pm.Encoder, tmp_path: Path) -> None:
    first, again, moved, other = (tmp_path / f"{name}.pmk" for name in "abcd")
    ids = np.arange(60)
    descriptors, positions = random_descriptors(60), np.random.default_rng(0).normal(size=(60, 3))
    noisy = descriptors ^ (np.random.default_rng(1).random(descriptors.shape) < 0.1)
    for file, seen, at in (
        (first, descriptors, positions),
        (again, noisy, positions + 0.01),
        (moved, noisy, 2 * positions),
        (other, descriptors[::-1], positions),
    ):
        scene = pm.PrototypeMap(encoder)
        scene.add(ids, np.ascontiguousarray(seen))
        scene.set_positions(ids, at)
        scene.save(file)
    output = tmp_path / "merged.pmk"
    for file, message in ((other, "60 ids are in an earlier map, too"), (moved, "lie elsewhere")):
        done = protomark("merge", first, file, "-o", output)
        assert (done.returncode, output.exists()) == (1, False)
        assert f"{file}: " in done.stderr
        assert message in done.stderr
        assert protomark("merge", first, file, "-o", output, "--renumber").returncode == 0
        output.unlink()
    assert "60 of them in an earlier map" in protomark("merge", first, again, "-o", output).stdout


def test_what_cannot_be_merged_or_split_is_refused(encoder: pm.Encoder, tmp_path: Path) -> None:
    one, short, sealed = (tmp_path / name for name in ("one.pmk", "short.pmk", "sealed.pmk"))
    scene = pm.PrototypeMap(encoder)
    scene.add([1, 2], random_descriptors(2))
    scene.save(one)
    scene.seal(sealed)
    pm.PrototypeMap(encoder, dim=5).save(short)
    (tmp_path / "two.pmk").write_bytes(one.read_bytes())
    before = one.read_bytes()
    output = tmp_path / "out.pmk"
    calls = [
        (["merge", one, "-o", output], "name at least two maps"),
        (["merge", one, tmp_path / "." / "one.pmk", "-o", output], "is named twice"),
        (["merge", one, tmp_path / "two.pmk", "-o", one], "is an input of this command"),
        (["merge", one, short, "-o", output], f"{short}: maps of different encoders or dimensions"),
        (["merge", one, sealed, "-o", output], "is a sealed map, which keeps no sums"),
        (["merge", one, tmp_path / "none.pmk", "-o", output], "No such file"),
        (["merge", one, short, "-o", tmp_path / "none" / "out.pmk"], "no such folder"),
        (["split", one, "-o", tmp_path], "one of --ids, --parts and --cell-size"),
        (["split", one, "--parts", 2, "--ids", "1", "-o", tmp_path], "one of --ids"),
        (["split", one, "--parts", 3, "-o", tmp_path], "a map of 2 landmarks has 1 to 2"),
        (["split", one, "--ids", "3,2", "-o", tmp_path], "--ids 3,2: ids must ascend"),
        (["split", one, "--cell-size", 0, "-o", tmp_path], "--cell-size 0 is not above 0"),
        (["split", one, "--parts", 2, "-o", one], "one.pmk is not a folder"),
        (["split", sealed, "--parts", 2, "-o", tmp_path], "is a sealed map"),
    ]
    for arguments, message in calls:
        done = protomark(*arguments)
        assert done.returncode == 1
        # A progress bar that has gone leaves an empty line.
        assert done.stderr.lstrip().startswith("error: ")
        assert message in done.stderr.replace("\n", " ")
        assert not output.exists()
    assert one.read_bytes() == before
