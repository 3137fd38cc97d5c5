import torch

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Background
from sparsestreet.scene.rendering import BACKGROUND_COLOR, NODE_COLORS, project_centers
from tests.scene.street import background, camera_at, view_at


def node_at(points: list[list[float]], opacity_logit: float = 0.0) -> Background:
    count = len(points)
    columns = {
        "means": torch.tensor(points),
        "log_scales": torch.zeros(count, 3),
        "quaternions": torch.ones(count, 4),
        "opacity_logits": torch.full((count,), opacity_logit),
        "sh_dc": torch.zeros(count, 1, 3),
        "sh_rest": torch.zeros(count, 0, 3),
    }
    return background(Rows(columns))


def test_dots_where_the_centers_project_the_nearest_on_top():
    camera = camera_at(0.0)  # 33 x 21, focal length 16.5, looking along +x from 1.5 m above the ground
    first = node_at([[10.0, 0.0, 1.5], [10.0, 5.0, 1.5], [-10.0, 0.0, 1.5]])
    second = node_at([[5.0, 0.0, 1.5], [20.0, 10.0, 1.5], [10.0, 0.0, -1.5]])
    image = project_centers(SceneGraph({"a": first, "b": second}), view_at(0.0, camera))
    assert image.shape == (21, 33, 3)
    expected = torch.full((21, 33, 3), BACKGROUND_COLOR)
    expected[10, 16] = torch.tensor(NODE_COLORS[1])  # b at 5 m hides a at 10 m
    expected[10, 8] = torch.tensor(NODE_COLORS[0])  # a at 10 m, 5 m to the left: 16.5 - 8.25; b is behind it
    expected[15, 16] = torch.tensor(NODE_COLORS[1])  # 3 m below the axis: 10.5 + 4.95
    assert torch.equal(image, expected)


def test_faint_rows_are_not_drawn():
    scene = SceneGraph({"a": node_at([[10.0, 0.0, 1.5]], opacity_logit=-6.0)})
    assert (project_centers(scene, view_at(0.0)) == BACKGROUND_COLOR).all()
    assert (project_centers(scene, view_at(0.0), min_opacity=0.001) != BACKGROUND_COLOR).any()


def test_colors_are_told_apart():
    colors = torch.tensor([(BACKGROUND_COLOR,) * 3, *NODE_COLORS])
    assert float(colors.min()) >= 0
    assert float(colors.max()) <= 1
    # A sixth of the range in some channel is seen at once.
    apart = (colors[:, None] - colors).abs().amax(-1) + torch.eye(len(colors))
    assert float(apart.min()) > 1 / 6
