"""The paper's figures for any trained run, laid out for print.

make.py is `crossray figure`: it writes the files. sheet.py says what a figure of pictures is made of, layout.py where
everything goes on paper, draw.py draws it. appearance.py, masks.py, depth.py and grids.py put the pictures together,
from what choose.py picks; curve.py is the one plot.
"""

from pipeline.figures.make import KINDS, Order, make_figure

__all__ = ["KINDS", "Order", "make_figure"]
