import hashlib
import multiprocessing
import os
import random
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from worker.blocks import BLOCK_BYTES
from worker.manifests import BorrowedBlocks, CorruptArtifact, GoneArtifact, UnknownArtifact
from worker.store import Store

#: Children start clean, as workers do: no thread or lock is inherited.
spawn = multiprocessing.get_context("spawn")


def id_(number=0, kind="energy"):
    return f"{kind}-{number:032x}"


def put(store, name=None, arrays=None, **more):
    name = id_() if name is None else name
    whole = {
        "kind": name.partition("-")[0],
        "spec": {"kind": "energy", "softmap": "softmap-" + "0" * 32},
        "parents": {"softmap": "softmap-" + "0" * 32},
        "values": {"dirichlet": 1.5},
        "made": {"seconds": 0.25},
    } | more
    return store.put(name, arrays={"density": np.arange(10.0)} if arrays is None else arrays, **whole)


def blobs(folder):
    return sorted((folder / "blobs").iterdir())


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def store(folder):
    return Store(folder)


# Arrays


LAYOUTS = {
    "C": lambda array: array,
    "Fortran": np.asfortranarray,
    "reversed": lambda array: array[::-1],
    "strided": lambda array: array[::2],
}
DTYPES = st.sampled_from(["<f8", ">f8", "<i8", ">i8", "<i4", ">i4", "?"])


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(DTYPES, hnp.array_shapes(min_side=0, max_dims=4)), st.sampled_from(list(LAYOUTS)))
def test_an_array_comes_back_as_it_went_in(array, layout):
    array = LAYOUTS[layout](array)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        manifest = put(store, arrays={"a": array})
        stored = store.array(manifest.id, "a")
        assert stored.dtype == array.dtype.newbyteorder("<")
        np.testing.assert_array_equal(stored, array)
        little = np.ascontiguousarray(array, dtype=stored.dtype).tobytes()
        assert hashlib.sha256(little).hexdigest() == manifest.arrays["a"].sha256
        assert b"".join(store.raw(manifest, "a")) == little
        assert manifest.arrays["a"].nbytes == len(little)


@pytest.mark.parametrize("shape", [(0,), (0, 3), (5, 0), (0, 0)])
def test_an_array_without_bytes_has_a_shape_all_the_same(store, folder, shape):
    manifest = put(store, arrays={"a": np.zeros(shape)})
    assert store.array(manifest, "a").shape == shape
    assert list(store.raw(manifest, "a")) == []
    assert manifest.arrays["a"].sha256 == hashlib.sha256().hexdigest()
    assert blobs(folder) == []


@pytest.mark.parametrize(
    ("array", "error"),
    [
        (np.array([object()]), TypeError),
        (np.array(["text"]), TypeError),
        (np.zeros(2, dtype=np.float32), TypeError),
        (np.zeros(2, dtype=complex), TypeError),
        (np.array(3.0), ValueError),
    ],
)
def test_an_array_that_cannot_be_kept_is_refused_and_nothing_is_written(store, folder, array, error):
    with pytest.raises(error, match="cannot be stored"):
        put(store, arrays={"good": np.ones(3), "bad": array})
    assert not store.has(id_())
    assert blobs(folder) == []


def test_values_that_json_does_not_hold_are_refused_and_nothing_is_left(store, folder):
    with pytest.raises(ValueError, match="JSON"):
        put(store, values={"dirichlet": float("nan")})
    assert not store.has(id_())
    assert blobs(folder) == []


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A store with an array of three and a half blocks, and the array."""
    rows = 7 * BLOCK_BYTES // 2 // 24
    array = np.random.default_rng(5).random((rows, 3))
    store = Store(tmp_path_factory.mktemp("large"))
    return store, put(store, arrays={"a": array}), array


def test_a_large_array_is_stored_in_blocks_of_whole_rows(large):
    _, manifest, array = large
    stored = manifest.arrays["a"]
    assert len(stored.blocks) == 4
    assert sum(block.rows for block in stored.blocks) == len(array)
    assert max(block.rows for block in stored.blocks) * stored.row_bytes <= BLOCK_BYTES
    assert stored.sha256 == hashlib.sha256(array).hexdigest()


@pytest.mark.parametrize(
    "rows",
    [
        slice(None),
        slice(5, 5),
        slice(7, 3),
        slice(1, 2),
        slice(-3, None),
        slice(10, 10**9),
        slice(200_000, 900_000),
    ],
)
def test_rows_are_read_as_a_slice_reads_them(large, rows):
    store, manifest, array = large
    np.testing.assert_array_equal(store.array(manifest, "a", rows.start, rows.stop), array[rows])


def test_rows_around_every_seam_are_read(large):
    store, manifest, array = large
    height = manifest.arrays["a"].blocks[0].rows
    for seam in (height, 2 * height, 3 * height):
        for start, stop in [(seam - 1, seam), (seam - 1, seam + 1), (seam, seam + 1), (seam - height, seam)]:
            np.testing.assert_array_equal(store.array(manifest, "a", start, stop), array[start:stop])


@pytest.mark.parametrize(("start", "stop"), [(0, 0), (0, 1), (8_388_607, 8_388_610), (3, 20_000_001)])
def test_bytes_are_read_from_anywhere_to_anywhere(large, start, stop):
    store, manifest, array = large
    assert b"".join(store.raw(manifest, "a", start, stop)) == array.tobytes()[start:stop]


def test_rows_wider_than_a_block_are_blocks_of_their_own(store):
    array = np.arange(3 * (BLOCK_BYTES // 4), dtype=np.float64).reshape(3, -1)
    manifest = put(store, arrays={"a": array})
    assert [block.rows for block in manifest.arrays["a"].blocks] == [1, 1, 1]
    np.testing.assert_array_equal(store.array(manifest, "a", 1, 2), array[1:2])


def test_a_large_array_that_is_not_contiguous_is_stored(large):
    store, _, array = large
    turned = array.T[:, ::2].T
    np.testing.assert_array_equal(store.array(put(store, id_(1), {"a": turned}), "a"), turned)


# Manifests


def test_a_manifest_says_what_was_put(store, folder):
    manifest = put(store)
    assert store.manifest(manifest.id) == manifest
    assert Store(folder).manifest(manifest.id) == manifest
    assert manifest.values == {"dirichlet": 1.5}
    assert manifest.made == {"seconds": 0.25}
    assert manifest.arrays["density"].shape == (10,)
    assert store.has(manifest.id)


def test_the_first_artifact_of_a_name_stands(store, folder):
    first = put(store, arrays={"a": np.zeros(3)})
    second = put(store, arrays={"a": np.ones(3)})
    assert second == first
    assert store.array(first, "a").tolist() == [0, 0, 0]
    assert len(blobs(folder)) == 1


@pytest.mark.parametrize(
    "name", ["", "energy", "../../etc/passwd", "energy-" + "0" * 31, "energy-" + "0" * 32 + "/.."]
)
def test_what_is_no_id_is_unknown(store, name):
    assert store.manifest(name) is None
    assert not store.has(name)
    assert store.gone(name) is None
    assert store.job(name) is None
    with pytest.raises(UnknownArtifact):
        store.array(name, "density")
    with pytest.raises(ValueError, match="no id"):
        put(store, name, kind="energy")


def test_an_unknown_array_is_unknown(store):
    put(store)
    with pytest.raises(UnknownArtifact, match="no array 'gradient'"):
        store.array(id_(), "gradient")


def test_manifests_are_listed_in_pages_by_kind(store):
    for number in range(7):
        put(store, id_(number))
        put(store, id_(number, "energy_block"), arrays={})
    first = store.manifests("energy", limit=4)
    rest = store.manifests("energy", after=first[-1].id, limit=4)
    assert [manifest.id for manifest in first + rest] == [id_(number) for number in range(7)]
    assert len(store.manifests(limit=100)) == 14
    assert store.manifests("basis") == []


# Damage


def flip(path, position=0):
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-1])


def extend(path):
    path.write_bytes(path.read_bytes() + b"\0")


@pytest.mark.parametrize(
    "damage", [flip, truncate, extend, os.unlink], ids=["flip", "truncate", "extend", "unlink"]
)
@pytest.mark.parametrize(
    "read",
    [
        lambda store: store.array(id_(), "density"),
        lambda store: store.array(id_(), "density", 9, 10),
        lambda store: list(store.raw(id_(), "density", 72)),
    ],
    ids=["array", "rows", "raw"],
)
def test_damage_is_noticed_and_the_artifact_withdrawn(store, folder, damage, read):
    manifest = put(store)
    damage(blobs(folder)[0])
    with pytest.raises(CorruptArtifact):
        read(store)
    assert not store.has(id_())
    tombstone = store.gone(id_())
    assert (tombstone.reason, tombstone.spec) == ("corrupt", manifest.spec)
    with pytest.raises(GoneArtifact):
        store.array(id_(), "density")


def test_what_was_withdrawn_can_be_made_again(store, folder):
    put(store)
    flip(blobs(folder)[0])
    with pytest.raises(CorruptArtifact):
        store.array(id_(), "density")
    put(store)
    assert store.array(id_(), "density").tolist() == list(range(10))
    assert store.gone(id_()) is None


def test_a_reader_of_the_damaged_copy_does_not_withdraw_the_new_one(store, folder):
    old = put(store)
    flip(blobs(folder)[0])
    with pytest.raises(CorruptArtifact):
        store.array(old, "density")
    new = put(store)
    with pytest.raises(GoneArtifact):
        store.array(old, "density")
    assert store.manifest(id_()) == new


def test_only_the_blocks_that_are_read_are_verified(tmp_path):
    store = Store(tmp_path)
    array = np.zeros((3, BLOCK_BYTES // 8))
    manifest = put(store, arrays={"a": array})
    flip(tmp_path / "blobs" / manifest.arrays["a"].blocks[2].blob, 1000)
    assert store.array(manifest, "a", 0, 2).shape == (2, BLOCK_BYTES // 8)
    chunks = store.raw(manifest, "a")
    assert len(next(chunks)) == len(next(chunks)) == BLOCK_BYTES
    with pytest.raises(CorruptArtifact):
        next(chunks)


@pytest.mark.parametrize("position", [0, 64, 70, -1])
def test_a_damaged_manifest_is_withdrawn(store, folder, position):
    put(store)
    flip(folder / "artifacts" / id_(), position)
    assert store.manifest(id_()) is None
    assert store.gone(id_()).reason == "corrupt"


# Gathering


def shards(store, count=3):
    arrays = [np.random.default_rng(k).random((4 + k, 2)) for k in range(count)]
    names = [id_(k, "potential_block") for k in range(count)]
    for name, array in zip(names, arrays, strict=True):
        put(store, name, {"potential": array, "own": np.zeros(3)})
    return names, np.concatenate(arrays)


def gather(store, names, name=None):
    pieces = BorrowedBlocks(tuple((shard, "potential") for shard in names))
    return put(store, name or id_(0, "potential"), {"potential": pieces, "more": np.ones(2)}, adopts=names)


def test_a_gathered_array_is_its_shards_rows_in_the_same_blobs(store, folder):
    names, whole = shards(store)
    before = {path.name for path in blobs(folder)}
    manifest = gather(store, names)
    np.testing.assert_array_equal(store.array(manifest, "potential"), whole)
    np.testing.assert_array_equal(store.array(manifest, "potential", 3, 11), whole[3:11])
    assert manifest.arrays["potential"].sha256 == hashlib.sha256(whole).hexdigest()
    assert {block.blob for block in manifest.arrays["potential"].blocks} < before


def test_shards_go_when_they_are_gathered_and_leave_nothing_else(store, folder):
    names, _ = shards(store)
    manifest = gather(store, names)
    assert not any(store.has(name) for name in names)
    assert {path.name for path in blobs(folder)} == manifest.blobs
    assert all(store.gone(name) is None for name in names)


def test_shards_that_a_dead_gatherer_left_go_when_it_is_repeated(store, folder):
    names, whole = shards(store)
    manifest = put(store, id_(0, "potential"), {"potential": BorrowedBlocks(((names[0], "potential"),))})
    assert all(store.has(name) for name in names)
    assert gather(store, names) == manifest
    assert not any(store.has(name) for name in names)
    assert {path.name for path in blobs(folder)} == manifest.blobs
    np.testing.assert_array_equal(store.array(manifest, "potential"), whole[:4])


def test_a_missing_shard_is_named_and_nothing_is_left(store, folder):
    names, _ = shards(store)
    before = blobs(folder)
    with pytest.raises(UnknownArtifact, match=id_(9, "potential_block")):
        gather(store, [*names, id_(9, "potential_block")])
    assert not store.has(id_(0, "potential"))
    assert blobs(folder) == before


def test_a_damaged_shard_is_withdrawn_and_named(store, folder):
    names, _ = shards(store)
    flip(folder / "blobs" / store.manifest(names[1]).arrays["potential"].blocks[0].blob)
    with pytest.raises(CorruptArtifact, match=names[1]):
        gather(store, names)
    assert [store.has(name) for name in names] == [True, False, True]


def test_rows_of_different_shapes_are_not_gathered(store):
    put(store, id_(0, "potential_block"), {"potential": np.zeros((2, 2))})
    put(store, id_(1, "potential_block"), {"potential": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="2 shapes"):
        gather(store, [id_(0, "potential_block"), id_(1, "potential_block")])


# Forgetting


def test_nothing_is_evicted_below_the_limit(store):
    put(store)
    assert store.evict(80) == ()
    assert store.evict(79) == (id_(),)
    assert store.usage().bytes == 0
    assert store.gone(id_()).reason == "evicted"


def age(folder, name, seconds):
    os.utime(folder / name, (time.time() - seconds,) * 2)


def test_the_least_recently_read_goes_first(store, folder):
    for number, read_at in enumerate([300, 400, 200, 100]):  # seconds from now
        put(store, id_(number))
        store.array(id_(number), "density")
        age(folder, f"reads/{id_(number)}", -read_at)
    assert store.evict(160) == (id_(3), id_(2))
    assert store.has(id_(0))
    assert store.array(id_(1), "density").shape == (10,)


def test_reading_again_is_recorded_once_a_minute(store, folder):
    put(store)
    store.array(id_(), "density")
    age(folder, f"reads/{id_()}", 50)
    store.array(id_(), "density")
    assert time.time() - (folder / "reads" / id_()).stat().st_mtime > 40
    Store(folder).array(id_(), "density")
    assert time.time() - (folder / "reads" / id_()).stat().st_mtime < 40


def test_uploads_and_what_is_kept_stay(store):
    put(store, id_(0, "mesh"), spec=None)
    put(store, id_(0, "array"), spec=None)
    put(store, id_(1))
    put(store, id_(2))
    assert store.evict(0, keep={id_(1)}) == (id_(2),)


def test_blobs_that_another_artifact_borrows_outlive_their_lender(store, folder):
    names, whole = shards(store, 1)
    # A gatherer that died before it dropped its shards.
    manifest = put(store, id_(0, "potential"), {"potential": BorrowedBlocks(((names[0], "potential"),))})
    assert store.evict(0, keep={manifest.id}) == (names[0],)
    np.testing.assert_array_equal(store.array(manifest, "potential"), whole)
    assert {path.name for path in blobs(folder)} == manifest.blobs


# Several processes and threads


def put_forever(folder, ready):
    store = Store(folder)
    array = np.ones((6, BLOCK_BYTES // 8))
    ready.set()
    for number in range(10**6):
        put(store, id_(number), {"a": array})


@pytest.mark.parametrize("moment", ["first blob", "later"])
def test_a_writer_that_is_killed_leaves_only_orphans(store, folder, moment):
    ready = spawn.Event()
    child = spawn.Process(target=put_forever, args=(folder, ready))
    child.start()
    assert ready.wait(60)
    while not blobs(folder) or (moment == "later" and not (folder / "artifacts").is_dir()):
        time.sleep(0.001)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    standing = store.manifests(limit=10**6)
    for manifest in standing:
        assert store.array(manifest, "a").sum() == 6 * BLOCK_BYTES // 8
    assert moment == "later" or not standing
    swept = store.sweep(older_than=0)
    assert swept.blobs > 0 or swept.files > 0 or standing
    assert {path.name for path in blobs(folder)} == {blob for manifest in standing for blob in manifest.blobs}
    assert list((folder / "aside").iterdir()) == []


def put_many(folder, barrier, mark, names):
    store = Store(folder)
    for name in names:
        barrier.wait(60)
        put(store, name, {"a": np.full(1000, mark), "b": np.full(10, mark)})


def test_of_writers_at_once_exactly_one_wins_and_the_others_leave_nothing(store, folder):
    names = [id_(number) for number in range(10)]
    barrier = spawn.Barrier(3)
    children = [spawn.Process(target=put_many, args=(folder, barrier, float(k), names)) for k in range(3)]
    for child in children:
        child.start()
    for child in children:
        child.join()
        assert child.exitcode == 0
    manifests = store.manifests(limit=100)
    assert [manifest.id for manifest in manifests] == names
    assert {path.name for path in blobs(folder)} == {
        blob for manifest in manifests for blob in manifest.blobs
    }
    assert list((folder / "aside").iterdir()) == []
    for manifest in manifests:
        both = {*store.array(manifest, "a").tolist(), *store.array(manifest, "b").tolist()}
        assert len(both) == 1


def test_twins_that_gather_the_same_shards_both_succeed(store, folder):
    for number in range(15):
        names, whole = shards(store)
        name = id_(number, "potential")
        barrier, answers = threading.Barrier(2), []

        def twin(names=names, name=name, barrier=barrier, answers=answers):
            barrier.wait()
            try:
                answers.append(gather(store, names, name))
            except (GoneArtifact, UnknownArtifact) as error:
                answers.append(error)

        threads = [threading.Thread(target=twin) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        manifest = store.manifest(name)
        assert manifest in answers
        np.testing.assert_array_equal(store.array(manifest, "potential"), whole)
        assert not any(store.has(name) for name in names)
    assert store.sweep(0).blobs == 0


def test_evicting_during_a_gathering_never_breaks_what_stands(store):
    stop = threading.Event()
    pauses = random.Random(7)

    def evict():
        while not stop.wait(pauses.uniform(0, 0.2)):
            store.evict(0, keep=[id_(number, "potential") for number in range(1_000)])

    evictor = threading.Thread(target=evict)
    evictor.start()
    gathered = []
    try:
        deadline = time.monotonic() + 2
        while time.monotonic() < deadline or not gathered:
            try:
                names, whole = shards(store)
                gathered.append(gather(store, names, id_(len(gathered), "potential")))
            except (GoneArtifact, UnknownArtifact):
                continue
            np.testing.assert_array_equal(store.array(gathered[-1], "potential"), whole)
    finally:
        stop.set()
        evictor.join()
    assert len(store.manifests("potential", limit=1_000)) == len(gathered)
    for manifest in gathered:
        np.testing.assert_array_equal(store.array(manifest, "potential"), whole)


class Deadline(Exception):
    pass


def put_until_struck(folder, seconds, struck):
    def strike(number, frame):
        raise Deadline

    signal.signal(signal.SIGALRM, strike)
    array = np.ones((6, BLOCK_BYTES // 8))
    store = Store(folder)
    for number, delay in enumerate(seconds):
        signal.setitimer(signal.ITIMER_REAL, delay)
        try:
            put(store, id_(number), {"a": array})
        except Deadline:
            struck.value += 1
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)


def test_a_deadline_that_strikes_while_writing_leaves_nothing_half_made(store, folder):
    struck = spawn.Value("i", 0)
    child = spawn.Process(target=put_until_struck, args=(folder, [0.001, 0.003, 0.01, 0.03, 0.1], struck))
    child.start()
    child.join()
    assert child.exitcode == 0
    assert struck.value
    manifests = store.manifests()
    assert len(manifests) >= 5 - struck.value
    for manifest in manifests:
        assert store.array(manifest, "a").sum() == 6 * BLOCK_BYTES // 8
    # A thread may have been in the middle of a block: an orphan, like those of a writer that was killed.
    store.sweep(older_than=0)
    assert {path.name for path in blobs(folder)} == {blob for one in manifests for blob in one.blobs}
