import base64
import io
from xml.etree import ElementTree

import numpy as np
import torch
from PIL import Image

from fgtutor.evaluation.adaptation import WALL, make_map
from fgtutor.figures.maps_svg import DARK, draw_maps
from fgtutor.planning import plan


def test_the_picture_shows_the_map_the_right_way_up():
    terrain = make_map("toy", 1)
    ground = terrain.elevation
    tensor = torch.zeros(*ground.shape, 8)
    tensor[:40] = 1.0  # the west is feasible, the east is closed
    ones = np.ones(tensor.shape)
    route = plan(ones, 0 * ones, grid=ground, start=(1.0, 1.0), goal=(2.0, 1.0), cost="length")
    text = draw_maps(
        ground,
        {"early <1>": (tensor, None), "late": (tensor, route)},
        title="A & B",
        f_min=0.25,
        walls=ground.heights > WALL - 1e-3,
        places={"long": terrain.sections[2]},
    )
    svg = ElementTree.fromstring(text)
    space = "{http://www.w3.org/2000/svg}"
    words = [element.text for element in svg.iter(f"{space}text")]
    assert {"A & B", "early <1>: no way", "late: 1.0 m"} <= set(words)
    assert words.count("6 cm high") == 2  # two risers of 3 cm, in both panels
    assert len(list(svg.iter(f"{space}polyline"))) == 2  # one route, with a white border
    images = list(svg.iter(f"{space}image"))
    assert len(images) == 2
    data = images[0].get("href").removeprefix("data:image/png;base64,")
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
    assert pixels.shape == (*ground.shape[::-1], 3)
    bottom, top = pixels[-1], pixels[0]
    assert tuple(bottom[10]) == tuple(top[10]) == (0, 114, 178)
    assert tuple(bottom[70]) == (217, 217, 217)
    # At the bottom the way is walled off, at the top lies the last gate.
    assert tuple(bottom[39]) == DARK and tuple(top[39]) == (0, 114, 178)
