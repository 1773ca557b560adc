"""What a page's figure says in numbers is what was drawn, to the last digit, in the page's own colours."""

import re

from gateway.reporting.figure import new_figure, render_svg


def draw(theme):
    figure = new_figure(4, 3)
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.03125, 0.0325], color=theme.servo)
    axes.set_yticks([0.03125, 0.0325])
    axes.set_ylabel("length 1.23456 mm")
    return figure


def test_labels_keep_their_digits_and_coordinates_do_not():
    svg = render_svg(draw, "a title", "stem")
    texts = re.findall(r">([^<>]+)</text>", svg)
    assert "0.03125" in texts
    assert "0.03250" in texts
    assert "length 1.23456 mm" in texts
    assert not re.search(r"<path[^>]*\d\.\d{3}", svg)
    assert "var(--servo)" in svg
