"""A font that PDFs embed in a third of the time: DejaVu Sans with Latin letters and without layout tables.

Embedding works out a subset of the font for every file, and most of that time goes into tables for scripts
and ligatures that figures do not use. Letters that the light font lacks are taken from the whole one.
"""

from __future__ import annotations

from pathlib import Path

WHOLE, LIGHT = "DejaVu Sans", "acino_fte Sans"
_LETTERS = (range(0x20, 0x7F), range(0xA0, 0x180), range(0x2010, 0x2027), range(0x2212, 0x2213))
_UNUSED = ["GSUB", "GPOS", "GDEF", "FFTM", "PfEd", "BDF", "meta"]
_FAMILY = (1, 16)  # entries of a font's table of names


def add_light_font(folder: Path) -> list[str]:
    """Make the light font and tell matplotlib, in this process, of it.

    Parameters
    ----------
    folder : Path
        For the file, which is needed as long as figures are drawn.

    Returns
    -------
    list of str
        Families for ``font.family``.
    """
    from fontTools import subset
    from matplotlib import font_manager

    options = subset.Options(
        glyph_names=False, recommended_glyphs=True, layout_features=[], name_IDs=["*"], hinting=True
    )
    options.drop_tables += _UNUSED
    font = subset.load_font(font_manager.findfont(WHOLE), options)
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=[letter for letters in _LETTERS for letter in letters])
    subsetter.subset(font)
    for entry in font["name"].names:
        if entry.nameID in _FAMILY:
            entry.string = LIGHT
    path = folder / "light.ttf"
    subset.save_font(font, str(path), options)
    font_manager.fontManager.addfont(str(path))
    return [LIGHT, WHOLE]
