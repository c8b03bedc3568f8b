from shown import lines

from csac.console.waiting import Speed, progress_shown


def test_speed_looks_back_twenty_seconds(clock):
    speed = Speed(clock)
    assert speed.per_second() is None
    for total in (0, 10_000, 11_000, 12_000, 13_000):
        speed.add(total)
        clock.now += 10

    assert speed.per_second() == 100.0


def test_what_comes_seldom_has_a_speed_too(clock):
    speed = Speed(clock)
    for total in (0, 100, 300):
        speed.add(total)
        clock.now += 25
    assert speed.per_second() == 8.0


def test_elsewhere_than_on_a_terminal_a_line_comes_now_and_then(plain, clock):
    with progress_shown(plain, "playing", "steps", clock) as show:
        for done in range(71):
            show(10 * done, 1000)
            clock.now += 1
    # 10 steps a second over the last 20 seconds
    assert lines(plain) == [
        "playing: 300 of 1,000 steps, 1 min 10 s left",
        "playing: 600 of 1,000 steps, 40 s left",
    ]


def test_on_a_terminal_it_is_one_line_that_goes_away(terminal, clock):
    with progress_shown(terminal, "evaluating", "episodes", clock) as show:
        clock.now += 1
        show(3, 10)
        clock.now += 1
        show(4, 10)
    shown = terminal.file.getvalue()
    assert "evaluating: 4 of 10 episodes, 3 s left" in shown
    assert shown.endswith("\x1b[?25h\r\x1b[1A\x1b[2K")
