"""Loops that are joined, numbers in the place of arrays, memory that is used again; and what has to stay apart."""

from lyapnet.graphs.c_loops import Statement, arrange_statements


def lines_of(*statements, **sizes):
    """(lines, numbers in memory) of statements, each as (sizes of its loops, line)."""
    return arrange_statements([Statement(tuple(loops), line) for loops, line in statements], sizes)


def test_loops_over_the_same_entries_are_one_and_their_arrays_numbers():
    lines, size = lines_of(
        ([3], "v0[i0] = sin(x[i0]);"), ([3], "v1[i0] = v0[i0] + 1.0;"), ([3], "y[i0] = v1[i0] * v0[i0];"), v0=3, v1=3
    )
    assert size == 0
    assert lines == [
        "for (int i0 = 0; i0 < 3; i0++) {",
        "    double v0 = sin(x[i0]);",
        "    double v1 = v0 + 1.0;",
        "    y[i0] = v1 * v0;",
        "}",
    ]


def test_what_another_pass_writes_is_not_read_in_the_same_loops():
    lines, size = lines_of(([3], "v0[i0] = sin(x[i0]);"), ([3], "y[i0] = v0[2 - i0];"), v0=3)
    assert size == 3
    assert sum(line.startswith("for") for line in lines) == 2
    lines, size = lines_of(([], "v0[0] = 0.0;"), ([3], "v0[0] += x[i0];"), ([3], "y[i0] = v0[0];"), v0=1)
    assert sum(line.startswith("for") for line in lines) == 2
    assert lines[0] == "double v0 = 0.0;"


def test_a_loop_is_not_moved_before_what_it_depends_on():
    lines, _ = lines_of(
        ([3], "v0[i0] = x[i0];"), ([2], "v1[i0] = v0[i0 + 1];"), ([3], "v2[i0] = v0[i0] + v1[0];"),
        ([3], "y[i0] = v2[i0];"), v0=3, v1=2, v2=3,
    )  # fmt: skip
    text = "\n".join(lines)
    assert text.index("v1[i0] =") < text.index("v2 = v0[i0] + v1[0]")


def test_memory_is_used_again_once_the_last_read_is_past():
    chain = [([4], f"v{k + 1}[i0] = v{k}[3 - i0];") for k in range(6)]
    first, last = ([4], "v0[i0] = x[i0];"), ([4], "y[i0] = v6[3 - i0];")
    sizes = {f"v{k}": 4 for k in range(7)}
    _, size = lines_of(first, *chain, last, **sizes)
    assert size == 2 * 4
    _, size = lines_of(first, *chain, last, ([4], "z[i0] = v0[3 - i0];"), **sizes)
    assert size == 3 * 4, "v0 is still read at the end"


def test_an_entry_that_is_read_for_the_last_time_gives_its_place_to_the_next():
    first, last = ([4], "v0[i0] = x[i0];"), ([4], "y[i0] = v1[3 - i0];")
    between, sizes = ([2], "v2[i0] = v0[1 + i0];"), {"v0": 4, "v1": 4, "v2": 2}
    _, size = lines_of(first, between, ([4], "v1[i0] = v2[0] * v0[i0];"), last, **sizes)
    assert size == 4 + 2
    _, size = lines_of(first, between, ([4], "v1[i0] = v2[0] * v0[3 - i0];"), last, **sizes)
    assert size == 8 + 2, "another pass reads the entry that was written"
    _, size = lines_of(first, between, ([4, 4], "v1[i1] = v2[0] * v0[i1] + w0[4 * i0 + i1];"), last, **sizes)
    assert size == 8 + 2, "several passes read the entry"


def test_what_nobody_reads_is_left_out():
    lines, size = lines_of(([4], "v0[i0] = x[i0];"), ([4], "v1[i0] = v0[3 - i0];"), ([4], "y[i0] = x[i0];"), v0=4, v1=4)
    assert size == 0
    assert lines == ["for (int i0 = 0; i0 < 4; i0++)", "    y[i0] = x[i0];"]


def test_arrays_that_are_passed_or_indexed_by_numbers_stay_arrays():
    lines, size = lines_of(
        ([2], "v0[i0] = x[i0];"), ([], "v1[0] = x[0];"), ([2], "v2[i0] = v0[0 + (int)v1[0]];"),
        ([], "solve(1, 2, v1, v2);"), ([2], "y[i0] = v2[i0];"), v0=2, v1=1, v2=2,
    )  # fmt: skip
    assert size == 2 + 2 + 1
    assert any("(int)v1[0]" in line for line in lines)
