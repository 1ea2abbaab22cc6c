"""What is dropped, what is refused, and that nothing else is touched."""

from __future__ import annotations

import json

import numpy as np
import pytest

from torchrl_tsallis.data.curation import curate
from torchrl_tsallis.data.readers import read_demonstrations


def test_the_most_surprising_share_goes_and_the_source_stays(write_npz, write_ratings, hashes, tmp_path):
    path = write_npz()
    folder = write_ratings(path, [0.5, 3.0, 0.1, 0.2])
    before = hashes(path), hashes(folder)
    done = curate(folder, tmp_path / "out.npz", share=0.5)
    assert done.kept == ("2", "3") and done.dropped == {"1": "surprise 3", "0": "surprise 0.5"}
    assert (done.steps_kept, done.steps_dropped, done.written) == (7, 7, True)
    assert (hashes(path), hashes(folder)) == before
    said = json.loads((tmp_path / "out.npz.curation.json").read_text())
    assert said["dropped"] == done.dropped and said["kept"] == ["2", "3"]
    data, source = read_demonstrations(tmp_path / "out.npz")
    assert data["observation"][:, 0].tolist() == [7, 8, 9, 10, 11, 12, 13] and len(source.episodes) == 2


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        ({"below": 0.5}, ("2", "3")),
        ({"below": 0.50001}, ("0", "2", "3")),
        ({"share": 0.25}, ("0", "2", "3")),
        ({"share": 0.74}, ("2", "3")),
        ({"keep_list": ["3", 1]}, ("1", "3")),
    ],
)
def test_each_rule(write_npz, write_ratings, tmp_path, options, kept):
    folder = write_ratings(write_npz(), [0.5, 3.0, 0.1, 0.2])
    assert curate(folder, tmp_path / "out.npz", dry_run=True, **options).kept == kept
    assert not (tmp_path / "out.npz").exists()


def test_an_episode_without_a_surprise_is_kept(write_npz, write_ratings, tmp_path):
    folder = write_ratings(write_npz(), [0.5, None, 0.1, 2.0])
    assert curate(folder, tmp_path / "out.npz", below=1.0, dry_run=True).kept == ("0", "1", "2")


def test_a_keep_list_from_a_file(write_npz, write_ratings, tmp_path):
    folder, file = write_ratings(write_npz()), tmp_path / "keep.json"
    for text in ('["0", "2"]', '{"keep": [0, 2]}'):
        file.write_text(text)
        assert curate(folder, tmp_path / "out.npz", keep_list=file, dry_run=True).kept == ("0", "2")
    for text, match in (
        ('["7"]', "'7'"),
        ("[", "no JSON"),
        ('{"a": 1}', "must be a list"),
        ("[true]", "must be a list"),
    ):
        file.write_text(text)
        with pytest.raises((ValueError, TypeError), match=match):
            curate(folder, tmp_path / "out.npz", keep_list=file)


def test_an_unusable_rating_drops_nothing_by_itself(write_npz, write_ratings, tmp_path):
    folder = write_ratings(write_npz(), usable=False)
    for options in ({"share": 0.5}, {"below": 1.0}):
        with pytest.raises(ValueError, match="seeds do not agree.*keep_list"):
            curate(folder, tmp_path / "out.npz", **options)
    assert curate(folder, tmp_path / "by_hand.npz", keep_list=["0"]).kept == ("0",)
    assert any("not usable" in note for note in curate(folder, tmp_path / "out.npz", share=0.5, force=True).notes)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({}, "exactly one"),
        ({"share": 0.1, "below": 1.0}, "exactly one"),
        ({"share": 0.0}, "between 0 and 1"),
        ({"share": 1.0}, "between 0 and 1"),
        ({"share": float("nan")}, "finite"),
        ({"below": float("inf")}, "finite"),
        ({"share": True}, "finite"),
        ({"share": 0.1}, "at least 0.25"),
        ({"below": -1.0}, "all episodes would go"),
        ({"keep_list": []}, "all episodes would go"),
        ({"keep_list": ["0"], "drop": "samples"}, "names episodes"),
        ({"share": 0.5, "drop": "rows"}, "choose 'episodes'"),
        ({"share": 0.5, "remove": True}, "robomimic"),
        ({"share": 0.5, "name": "a/b"}, "without '/'"),
    ],
)
def test_bad_arguments_are_named(write_npz, write_ratings, tmp_path, options, match):
    folder = write_ratings(write_npz())
    with pytest.raises((ValueError, TypeError), match=match):
        curate(folder, tmp_path / "out.npz", **options)
    assert sorted(x.name for x in tmp_path.iterdir()) == ["data.npz", "ratings"]


def test_places_that_are_taken_or_lie_in_each_other(write_npz, write_ratings, tmp_path):
    path = write_npz()
    folder = write_ratings(path)
    before = path.read_bytes()
    for out in (path, folder / "out.npz"):
        with pytest.raises(ValueError, match="lie in each other"):
            curate(folder, out, share=0.5, overwrite=True)
    with pytest.raises(ValueError, match="must end with .npz"):
        curate(folder, tmp_path / "out.csv", share=0.5)
    (tmp_path / "mine.npz").write_text("mine")
    for overwrite, match in ((False, "overwrite=True"), (True, "no curated copy")):
        with pytest.raises(FileExistsError, match=match):
            curate(folder, tmp_path / "mine.npz", share=0.5, overwrite=overwrite)
    assert (tmp_path / "mine.npz").read_text() == "mine" and path.read_bytes() == before
    curate(folder, tmp_path / "out.npz", share=0.25)
    with pytest.raises(FileExistsError):
        curate(folder, tmp_path / "out.npz", share=0.5)
    assert curate(folder, tmp_path / "out.npz", share=0.5, overwrite=True).kept == ("0", "1")
    assert len(read_demonstrations(tmp_path / "out.npz")[1].episodes) == 2


@pytest.mark.parametrize("error", [RuntimeError("stop"), KeyboardInterrupt()])
def test_a_copy_that_is_stopped_leaves_nothing_and_an_earlier_one_as_it_was(
    fixtures, write_ratings, tmp_path, hashes, monkeypatch, error
):
    folder, out = write_ratings(fixtures / "lerobot_v3"), tmp_path / "out"
    for earlier in (False, True):
        if earlier:
            curate(folder, out, share=0.25)
        before = hashes(tmp_path)
        with monkeypatch.context() as patch:
            from torchrl_tsallis.data.curators.lerobot import LeRobotCurator

            def fail(*_):
                raise error

            patch.setattr(LeRobotCurator, "_write_info", fail)  # after rows and tables were written
            with pytest.raises(type(error)):
                curate(folder, out, share=0.5, overwrite=True)
        assert hashes(tmp_path) == before and out.exists() == earlier


def test_a_full_disk_is_named(write_npz, write_ratings, tmp_path, monkeypatch):
    folder = write_ratings(write_npz())

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="cannot write .*out.npz.*No space left"):
        curate(folder, tmp_path / "out.npz", share=0.5)
    assert sorted(x.name for x in tmp_path.iterdir()) == ["data.npz", "ratings"]


def test_data_that_changed_since(write_npz, write_ratings, tmp_path):
    path = write_npz()
    folder = write_ratings(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays["terminals"][0] = True
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match="rate the data again"):
        curate(folder, tmp_path / "out.npz", share=0.5)
    path.unlink()
    with pytest.raises(FileNotFoundError, match="not at"):
        curate(folder, tmp_path / "out.npz", share=0.5)


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("run.json", "{", "broken"),
        ("run.json", '{"format": 9}', "format 9"),
        ("run.json", '{"kind": "policy"}', "kind 'policy'"),
        ("run.json", '{"data": {"path": "", "format": "memory"}}', "in memory"),
        ("summary.json", "[]", "is list"),
        ("episodes.csv", "episode,source\n", "no column 'steps'"),
        ("episodes.csv", "episode,source,steps,surprise\n", "no episode"),
        ("episodes.csv", "episode,source,steps,surprise\n0,a,x,1\n", "'x' at line 2"),
        ("episodes.csv", "episode,source,steps,surprise\n0,a,3\n", "3 cells"),
        ("episodes.csv", "episode,source,steps,surprise\n0,a,3,1\n1,a,3,1\n", "once"),
        ("ratings.csv", "row,episode,step,surprise,rating,surprise_seen\n0,0,0,1,1,1\n", "two ratings"),
        ("ratings.csv", None, "not there"),
    ],
)
def test_broken_folders(write_npz, write_ratings, tmp_path, file, text, match):
    folder = write_ratings(write_npz())
    (folder / file).unlink() if text is None else (folder / file).write_text(text)
    with pytest.raises((ValueError, FileNotFoundError), match=match):
        curate(folder, tmp_path / "out.npz", share=0.5)
    with pytest.raises(FileNotFoundError, match="no folder"):
        curate(tmp_path / "nowhere", tmp_path / "out.npz", share=0.5)


def test_pickled_members_are_left_out(write_npz, write_ratings, tmp_path):
    folder = write_ratings(write_npz(infos=np.array([{"a": 1}] * 14)))
    done = curate(folder, tmp_path / "out.npz", share=0.5)
    assert "infos" in done.notes[0]
    with np.load(tmp_path / "out.npz", allow_pickle=False) as archive:
        assert "infos" not in archive and str(archive["name"]) == "x"
        assert archive["rating"].tolist() == [1.0] * 3 + [0.5] * 4
