"""Messages on many runs: few stay as they are, many are one line with their number, the first runs and the ranges."""

from balance_cli.io.run_messages import MOST_LINES, RunMessage, message_lines, messages_of_runs


def of_channel(index, channel="z2.strain"):
    name = f"wind-{index:03d}"
    return RunMessage(name, f"{name}: channel {channel} left out: {index} values of 4P beyond -{index}.5e-3 V")


def test_few_runs_have_a_line_each():
    messages = [of_channel(index) for index in range(MOST_LINES)]
    assert list(message_lines(messages)) == [message.text for message in messages]


def test_many_runs_are_one_line_with_ranges_of_the_numbers_that_differ():
    assert list(message_lines(of_channel(index) for index in (7, 3, 12, 5))) == [
        "4 runs (wind-007, wind-003, wind-012, ...): channel z2.strain left out: 3 to 12 values of 4P "
        "beyond -12.5e-3 to -3.5e-3 V"
    ]


def test_channels_and_words_make_kinds_of_their_own_in_the_order_of_the_first():
    pairs = [of_channel(index, channel) for index in range(10) for channel in ("x1", "x2")]
    lines = list(message_lines([*pairs, RunMessage("wind-3", "wind-3: bridged")]))
    assert [line.partition(" left out")[0] for line in lines] == [
        "10 runs (wind-000, wind-001, wind-002, ...): channel x1",
        "10 runs (wind-000, wind-001, wind-002, ...): channel x2",
        "wind-3: bridged",
    ]


def test_a_run_with_several_messages_of_one_kind_counts_once():
    messages = [RunMessage(name, f"{name}: gap of {size} samples") for name in ("a", "b") for size in (2, 3)]
    assert list(message_lines(messages)) == ["2 runs (a, b): gap of 2 to 3 samples"]


def test_runs_are_found_in_texts_as_whole_words():
    names = {"wind-1", "wind-10", "wind-2"}
    texts = ["loads of wind-10 are turned.", "noise in wind-2.", "the geometry has no rotor"]
    assert [message.run for message in messages_of_runs(texts, names)] == ["wind-10", "wind-2", ""]


def test_messages_on_no_run_stay_as_they_are():
    texts = [f"limit {index}" for index in range(9)]
    assert list(message_lines(messages_of_runs(texts, ["wind-1"]))) == texts
