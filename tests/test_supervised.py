"""The command ``benchmarks.supervised``: images, tasks, online accuracy, exact resume, tables written by hand."""

import gzip
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th

from benchmarks.supervised import __main__ as command
from benchmarks.supervised import training
from benchmarks.supervised.images import IDX_FILES, Images, load_images, read_idx
from benchmarks.supervised.learner import BATCH_SIZE, METHODS, Learner, Settings
from benchmarks.supervised.tables import read_results, results_table
from benchmarks.supervised.tasks import PROBLEMS, Task, draw, make_task, permuted_pixels
from benchmarks.supervised.training import Run, n_done, read_about, read_accuracies, train

N_PIXELS = 6


@pytest.fixture
def images():
    """64 images, the pixels of image i being i, i + 0.1, … i + 0.5, all over 64; its label is i % 10."""
    rows = (th.arange(64).float()[:, None] + 0.1 * th.arange(N_PIXELS)) / 64
    return Images("made up (64 images of 2x3)", rows, th.arange(64) % 10)


@pytest.fixture
def make_run(tmp_path):
    def make(method="cchain", problem="permuted_mnist", seed=0, folder="a", **settings):
        return Run(
            problem, method, seed, Settings(**settings), 48, 2, tmp_path / folder / "results", tmp_path / folder / "logs"
        )

    return make


def ids(pixels):
    """Which images these are, in whatever order the pixels are."""
    return (pixels.min(dim=1).values * 64).round().long()


# --- Tasks


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_task_follows_from_seed_and_number(images, name):
    first, again, second, other = (
        make_task(PROBLEMS[name], images, 32, seed, index)[0] for seed, index in ((0, 0), (0, 0), (0, 1), (1, 0))
    )
    assert first.pixels.equal(again.pixels) and first.labels.equal(again.labels)
    for different in (second, other):
        assert not (first.pixels.equal(different.pixels) and first.labels.equal(different.labels))


def test_random_labels_are_those_of_the_same_images_dealt_out_anew(images):
    tasks = [make_task(PROBLEMS["random_label_mnist"], images, 48, 0, index)[0] for index in range(3)]
    true_labels = ids(tasks[0].pixels) % 10
    for task in tasks:
        assert task.pixels.equal(tasks[0].pixels) and len(set(ids(task.pixels).tolist())) == 48
        assert sorted(task.labels.tolist()) == sorted(true_labels.tolist())
        assert (task.labels == true_labels).float().mean() < 0.4  # 0.1 by chance
    assert not tasks[1].labels.equal(tasks[2].labels)


def test_all_images_of_a_task_have_their_pixels_in_the_same_order(images):
    tasks = [make_task(PROBLEMS["permuted_mnist"], images, 48, 0, index)[0] for index in range(3)]
    orders = []
    for task in tasks:
        (order,) = set(map(tuple, task.pixels.argsort(dim=1).tolist()))
        orders.append(order)
        assert sorted(order) == list(range(N_PIXELS))
        assert task.labels.equal(ids(task.pixels) % 10)  # they keep their labels
    assert len(set(orders)) == 3
    assert set(ids(tasks[0].pixels).tolist()) != set(ids(tasks[1].pixels).tolist())


def test_images_are_repeated_only_where_there_are_too_few(images):
    assert len(set(draw(np.random.default_rng(0), images, 64).tolist())) == 64
    many = draw(np.random.default_rng(0), images, 96)
    assert len(many) == 96 and len(set(many.tolist())) < 64


# --- Learning


def test_online_accuracy_by_hand():
    """The network says 3 at first. An enormous step on the first minibatch of 3s and 4s makes it say 4 from then on."""
    learner = Learner("vanilla", Settings(optimizer="sgd", learning_rate=100.0), n_pixels=1, seed=0)
    with th.no_grad():
        for parameter in learner.network.parameters():
            parameter.zero_()
        list(learner.network.parameters())[-1][3] = 1.0
    labels = th.tensor(4 * [3] + 12 * [4])
    batch = th.zeros(16, 1), labels, th.zeros(16, 1)
    assert [learner.update(*batch).item() for _ in range(2)] == [4, 12]


def test_a_task_is_learned_in_minibatches_with_others_for_reference(images, monkeypatch):
    """Three minibatches in each of two epochs, of which 1, 2, … 6 images are right."""
    seen = []

    def update(self, pixels, labels, reference):
        assert labels.equal(ids(pixels) % 10)
        seen.append((ids(pixels).tolist(), ids(reference).tolist()))
        return th.tensor(len(seen))

    monkeypatch.setattr(Learner, "update", update)
    learner = Learner("cchain", Settings(), N_PIXELS, seed=0)
    accuracy = learner.learn(Task(images.pixels[:48], images.labels[:48]), 2, np.random.default_rng(0))
    assert accuracy == (1 + 2 + 3 + 4 + 5 + 6) / (6 * 16)
    for epoch in (seen[:3], seen[3:]):
        assert sorted(number for batch, _ in epoch for number in batch) == list(range(48))  # each image once
        for batch, reference in epoch:
            assert len(batch) == len(reference) == 16 and not set(batch) & set(reference)
    assert seen[0] != seen[3]


@pytest.mark.parametrize("method", METHODS)
def test_each_method_learns(method, images):
    """The label of an image is its number modulo 10; here only the first five images, again and again."""
    task = Task(images.pixels[:5].repeat(16, 1), images.labels[:5].repeat(16))
    learner = Learner(method, Settings(learning_rate=0.01), N_PIXELS, seed=0)
    first, last = (learner.learn(task, 20, np.random.default_rng(seed)) for seed in range(2))
    assert last > first > 0.2 and last > 0.5


@pytest.mark.parametrize(
    "method, switched_off",
    [("cchain", {"churn_coef": "0"}), ("l2_init", {"l2_init_coef": 0.0}), ("weight_clipping", {"clip_ratio": 1e6})],
)
def test_a_method_that_is_switched_off_is_vanilla(method, switched_off, images):
    def learn(method, **settings):
        learner = Learner(method, Settings(**settings), N_PIXELS, seed=0)
        return learner.learn(task, 3, np.random.default_rng(0)), th.cat([p.flatten() for p in learner.network.parameters()])

    task = permuted_pixels(images, 64, np.random.default_rng(0), np.random.default_rng(1))
    vanilla, off, on = learn("vanilla"), learn(method, **switched_off), learn(method, clip_ratio=0.1)
    assert off[0] == vanilla[0] and off[1].equal(vanilla[1])
    assert not on[1].equal(vanilla[1])


# --- Runs


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("problem", PROBLEMS)
def test_a_run_goes_on_as_if_it_had_not_been_interrupted(method, problem, images, make_run, monkeypatch):
    def interrupt(progress):
        if len(progress.accuracies) == 3:
            raise KeyboardInterrupt

    saved, final = [], []
    whole, interrupted = make_run(method, problem), make_run(method, problem, folder="b")
    train(whole, images, 5)
    with monkeypatch.context() as context:
        context.setattr(training, "SAVE_INTERVAL", -1.0)  # after each task
        with pytest.raises(KeyboardInterrupt):
            train(interrupted, images, 5, interrupt)
    assert n_done(interrupted) == 3
    train(interrupted, images, 5, lambda progress: saved.append(len(progress.accuracies)))
    assert saved == [3, 4, 5]
    for run in (whole, interrupted):
        final.append((read_accuracies(run.folder).tolist(), th.load(run.state)["learner"]["network"]))
    (accuracies, parameters), (resumed_accuracies, resumed_parameters) = final
    assert len(accuracies) == 5 and accuracies == resumed_accuracies
    assert all(parameters[name].equal(resumed_parameters[name]) for name in parameters)


def test_a_run_of_the_papers_length_leaves_results_alone(images, make_run, monkeypatch):
    monkeypatch.setitem(
        training.PROBLEMS, "permuted_mnist", PROBLEMS["permuted_mnist"].__class__("", permuted_pixels, 2, 48, 1)
    )
    run = make_run()
    train(run, images, 2)
    assert n_done(run) == 2 and not run.state.parent.exists()
    about = read_about(run.folder)
    assert about["updates"] == 2 * 2 * 3 and about["processor_seconds"] >= 0 and about["versions"]["torch"] == th.__version__
    assert about["settings"]["data"] == images.source and about["settings"]["target_churn_ratio"] == 2
    assert "clip_ratio" not in about["settings"]  # it has none


def test_results_of_other_settings_are_refused(images, make_run):
    train(make_run(), images, 1)
    train(make_run(clip_ratio=2.0), images, 1)  # of another method
    with pytest.raises(ValueError, match=r"was made with learning_rate 0\.001 instead of 0\.01\. Delete it, or"):
        train(make_run(learning_rate=0.01), images, 2)
    other = Images(images.source, images.pixels + 1, images.labels)
    with pytest.raises(ValueError, match="was made with checksum"):
        train(make_run(), other, 2)
    # Another seed of the same method, with which the table would average it
    with pytest.raises(ValueError, match=r"cchain_seed_0 was made with learning_rate 0\.001 instead of 0\.01"):
        train(make_run(learning_rate=0.01, seed=1), images, 1)
    (make_run().folder / "run.json").unlink()
    with pytest.raises(ValueError, match=r"state\.pt was made with other settings"):
        train(make_run(learning_rate=0.01), images, 2)


def test_results_are_kept_where_the_run_cannot_go_on(images, make_run):
    run = make_run()
    train(run, images, 2)
    run.state.unlink()
    with pytest.raises(ValueError, match=r"has 2 tasks, but .*state\.pt, from which the run would go on, is missing"):
        train(run, images, 3)
    assert n_done(run) == 2
    train(run, images, 2)


# --- Images


def write_idx(path, array, head=b"\0\0\x08"):
    content = head + bytes([array.ndim]) + np.array(array.shape, ">u4").tobytes() + array.astype(np.uint8).tobytes()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)


@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_reads_the_files_of_mnist(tmp_path, suffix):
    pixels = np.array([[[0, 255, 51]], [[255, 0, 0]]])
    for name, array in zip(IDX_FILES, (pixels, np.array([7, 9])), strict=True):
        write_idx(tmp_path / f"{name}{suffix}", array)
    assert read_idx(tmp_path / f"{IDX_FILES[0]}{suffix}").tolist() == pixels.tolist()
    loaded = load_images(str(tmp_path))
    assert loaded.source == "MNIST's files (2 images of 1x3)" and loaded.labels.tolist() == [7, 9]
    assert loaded.pixels.tolist() == pytest.approx(np.array([[-1, 1, -0.6], [1, -1, -1]]))


@pytest.mark.parametrize(
    "content, message",
    [
        (b"\0\0\x09\x01\0\0\0\x01\0", "must be an IDX file of bytes"),
        (b"", "must be an IDX file of bytes"),
        (b"\0\0\x08\x01\0\0\0\x02\0", "does not hold as many bytes"),
        (b"\0\0\x08\x03\0\0\0\x02", "does not hold as many bytes"),
    ],
)
def test_damaged_files_are_refused(tmp_path, content, message):
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_idx(path)


def test_damaged_compressed_files_are_refused(tmp_path):
    path = tmp_path / "file.gz"
    for content in (b"no gzip", gzip.compress(bytes(100))[:-20]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"file\.gz is damaged"):
            read_idx(path)


def test_labels_must_go_with_the_images(tmp_path):
    write_idx(tmp_path / IDX_FILES[0], np.zeros((2, 1, 3)))
    write_idx(tmp_path / IDX_FILES[1], np.zeros(3))
    with pytest.raises(ValueError, match=r"must hold images and a label .* got shapes \(2, 1, 3\) and \(3,\)"):
        load_images(str(tmp_path))


@pytest.mark.parametrize("data, names", [(None, "scikit-learn for its digits"), ("mnist", "needs torchvision")])
def test_without_images_the_error_says_what_to_install(monkeypatch, data, names):
    monkeypatch.setattr("benchmarks.supervised.images.find_spec", lambda name: None)
    for package in ("torchvision", "torchvision.datasets", "sklearn", "sklearn.datasets"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf'{names}[^"]*(pip install|--data)'):
        load_images(data)


# --- Command and tables


def result(folder: Path, method: str, seed: int, accuracies, seconds=10.0, problem="random_label_mnist"):
    folder = folder / problem / f"{method}_seed_{seed}"
    folder.mkdir(parents=True)
    (folder / "accuracy.csv").write_text("task,accuracy\n" + "".join(f"{i},{a}\n" for i, a in enumerate(accuracies)))
    settings = {"seed": seed, "data": "made up", "images": 1200, "epochs": 400}
    about = {"settings": settings, "updates": 30_000 * len(accuracies), "processor_seconds": seconds}
    (folder / "run.json").write_text(json.dumps(about))


def rows(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if line.startswith("|")]


def test_a_table_of_the_results(tmp_path):
    result(tmp_path, "vanilla", 0, [0.2] * 10 + [0.4] * 10)
    result(tmp_path, "vanilla", 10, [0.4] * 10 + [0.6] * 10 + [1.0])  # the last task is not counted: seed 0 has 20
    result(tmp_path, "l2_init", 0, [0.5] * 50, seconds=600)
    table = results_table("random_label_mnist", read_results(tmp_path, "random_label_mnist"))
    assert rows(table)[0] == ["", "seeds", "tasks", "accuracy", "first 10% of tasks", "last 10%", "paper (3 seeds, 50 tasks)"]
    assert rows(table)[2:] == [
        ["Vanilla", "2", "20", "0.4000 ± 0.1000", "0.3000 ± 0.1000", "0.5000 ± 0.1000", "0.1501 ± 0.0030"],
        ["C-CHAIN", "0", "0", "", "", "", "0.2482 ± 0.0141"],
        ["L2 Init", "1", "50", "0.5000", "0.5000", "0.5000", "0.8607 ± 0.0021"],
        ["Weight clipping", "0", "0", "", "", "", "0.4304 ± 0.0052"],
    ]
    text = " ".join(table.split())
    # 41 tasks of 30 000 updates in 20 seconds; 1 500 000 updates in 600
    assert "Data: made up. A task: 1200 images, 400 epochs. " in text
    assert "Updates in a second of processor time: Vanilla: 61500; L2 Init: 2500." in text
    # 109 · 30 000 / 61 500 + 100 · 30 000 / 2500 seconds = 1253 seconds
    assert "Vanilla: 109 tasks; C-CHAIN: 150 tasks; L2 Init: 100 tasks; Weight clipping: 150 tasks. " in text
    assert text.endswith("That is 0.3 core-hours at this speed, without the methods that have no run yet.")


def test_the_command(tmp_path, images, monkeypatch, capsys):
    monkeypatch.setattr(command, "load_images", lambda data: images)
    monkeypatch.setattr(command, "updates_per_second", lambda run, images: 3600.0)
    arguments = ["--results", str(tmp_path / "results"), "--logs", str(tmp_path / "logs"), "--docs", str(tmp_path / "docs")]
    chosen = ["--problem", "permuted_mnist", "--method", "vanilla", "cchain", "--seeds", "1"]
    short = [*chosen, "--images", "48", "--epochs", "1", *arguments]
    command.main([*short, "--tasks", "2", "--dry-run"])
    assert "0 of 2" in (shown := capsys.readouterr().out) and "cchain" in shown and not (tmp_path / "results").exists()
    command.main([*short, "--tasks", "2"])
    assert len(rows(capsys.readouterr().out)) == 2 + len(METHODS)
    command.main([*short, "--tasks", "3"])
    folder = tmp_path / "results/permuted_mnist/cchain_seed_1"
    assert len(read_accuracies(folder)) == 3 and read_about(folder)["settings"]["images"] == 48

    page = tmp_path / "docs/page.md"
    page.parent.mkdir()
    page.write_text("".join(f"<!-- table: supervised_{name} -->\n<!-- end -->\n" for name in PROBLEMS))
    command.main(["--write", *arguments])
    assert "| C-CHAIN | 1 | 3 |" in page.read_text() and "No run is done yet." in page.read_text()
    assert (tmp_path / "docs" / command.PICTURE).read_bytes().startswith(b"\x89PNG")

    capsys.readouterr()
    with pytest.raises(SystemExit):
        command.main([*short, "--learning-rate", "0.1"])
    assert "was made with learning_rate 0.001 instead of 0.1" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--problem", "cifar"], "invalid choice: 'cifar'"),
        (["--method", "trac"], "invalid choice: 'trac'"),
        (["--seeds", "-1"], "`seeds` must be an integer greater than or equal to 0, got -1"),
        (["--tasks", "0"], "`tasks` must be an integer greater than or equal to 1, got 0"),
        (["--epochs", "0"], "`epochs` must be an integer greater than or equal to 1, got 0"),
        (["--images", "100"], f"`images` must be a multiple of {BATCH_SIZE}, at least {2 * BATCH_SIZE}, got 100"),
        (["--images", "16"], "`images` must be a multiple of 16, at least 32, got 16"),
        (["--learning-rate", "0"], "`learning_rate` must be a number greater than 0, got 0.0"),
        (["--target-churn-ratio", "-1"], "`target_churn_ratio` must be a number greater than 0, got -1.0"),
        (["--churn-coef", "much"], '`churn_coef` must be a number, "auto"'),
        (["--l2-init-coef", "-1"], "`l2_init_coef` must be a number greater than or equal to 0, got -1.0"),
        (["--clip-ratio", "0"], "`clip_ratio` must be a number greater than 0, got 0.0"),
        (["--data", "nowhere"], '--data must be "mnist", "digits" or a folder with train-images-idx3-ubyte'),
    ],
)
def test_bad_arguments_are_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as error:
        command.main(arguments)
    assert error.value.code == 2 and message in " ".join(capsys.readouterr().err.split())
