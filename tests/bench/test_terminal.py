from olpm_bench.bench.terminal import LONGEST, one_line, plain_console


def test_names_are_printed_as_they_are(capsys):
    plain_console().print("ends.py:leaves: [red] 3.5")
    assert capsys.readouterr().out == "ends.py:leaves: [red] 3.5\n"


def test_a_line_neither_steers_the_terminal_nor_fills_it():
    assert one_line("a\x1b[2K\r\nb é") == "a\\x1b[2K\\r\\nb é"
    assert len(one_line("x" * 10 * LONGEST)) < LONGEST + 10
