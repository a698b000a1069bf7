"""Publishing: the page names its command, the README's table is renewed between its marks, stale plots go away."""

from made_up import write_sweep

from pipelines.provenance import commit_words
from pipelines.publish import copy_report, main


def test_a_sweep_becomes_a_page_and_a_table_in_the_readme(tmp_path):
    outputs, docs, readme = tmp_path / "outputs", tmp_path / "docs", tmp_path / "README.md"
    write_sweep(outputs)
    docs.mkdir()
    (docs / "beam_sweep_of_last_year.png").write_bytes(b"stale")
    (docs / "another_plot.png").write_bytes(b"kept")
    other = "<!-- results other -->\nx\n<!-- end -->\n"
    readme.write_text(f"# T\n<!-- results beam_sweep -->\nold\n<!-- end -->\nrest\n{other}")
    (docs / "lab.md").write_text("<!-- results beam_sweep -->\nold\n<!-- end -->\n")
    call = ["beam_sweep", "--outputs", str(outputs), "--docs", str(docs), "--readme", str(readme)]
    assert main([*call, "--command", "make sweep"]) == 0
    page = (docs / "beam_sweep.md").read_text()
    assert "Made by `make sweep`" in page
    assert not (docs / "beam_sweep_of_last_year.png").exists()
    assert (docs / "another_plot.png").exists()
    for plot in docs.glob("beam_sweep_*.png"):
        assert f"]({plot.name})" in page
    text = readme.read_text()
    assert "old" not in text and "rest" in text and "| static |" in text
    assert text.endswith(other)
    assert "| static |" in (docs / "lab.md").read_text()  # pages of docs/ have such tables too
    assert main([*call, "--command", "make sweep"]) == 0
    assert readme.read_text() == text  # the same sweep gives the same page


def test_nothing_finished_is_one_sentence(tmp_path, capsys):
    assert main(["x", "--outputs", str(tmp_path), "--docs", str(tmp_path), "--readme", str(tmp_path / "no")]) == 1
    assert "Nothing was run" in capsys.readouterr().err


def test_a_report_replaces_what_an_earlier_one_left(tmp_path):
    report, docs = tmp_path / "report", tmp_path / "docs"
    report.mkdir()
    docs.mkdir()
    (report / "bench.md").write_text("new")
    (docs / "bench_stale.png").write_bytes(b"x")
    (docs / "other.md").write_text("kept")
    assert copy_report(report, "bench*", docs) == docs
    assert {file.name: file.read_text() for file in docs.iterdir()} == {"bench.md": "new", "other.md": "kept"}


def test_a_page_says_when_files_differ_from_its_commit():
    assert commit_words("0123456789abcdef") == "0123456789ab"
    assert commit_words("0123456789abcdef+changes") == "0123456789ab with uncommitted changes"
