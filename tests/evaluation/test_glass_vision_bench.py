"""The command line judges a folder and says with its status whether the goals are met."""

import cv2
import torch

from tests.perception.made_up_glass import drawn
from zsdt.evaluation.glass_vision_bench import main
from zsdt.perception.glass_segmentation import OUTPUTS
from zsdt.perception.unet import UNet, UNetOptions
from zsdt.perception.unet_weights import save_unet

SMALL = UNetOptions([4, 8, 8])


def test_a_folder_is_judged_and_missed_goals_show_in_the_status(tmp_path, capsys):
    torch.manual_seed(0)
    save_unet(tmp_path / "weights", UNet(SMALL, OUTPUTS), SMALL, {"size": 64})
    for k in range(4):
        image, container, liquid = drawn(level=50 + 10 * k)
        for name, picture in (("images/{}", image), ("masks/{}", container.astype("uint8") + liquid)):
            path = tmp_path / "own" / (name.format(k) + ".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), picture)
    arguments = [str(tmp_path / "weights"), str(tmp_path / "out"), "--folder", str(tmp_path / "own"), "--every", "2"]
    assert main([*arguments, "--threads", "1", "--about", "Made up."]) == 1
    assert "| images | 2 |" in capsys.readouterr().out
    page = (tmp_path / "out/glass_vision.md").read_text()
    assert "Made up." in page and "wall time against threads" in page and "own/0" in page
    assert main([*arguments, "--video"]) == 1
    assert "| images | 2 |" in capsys.readouterr().out and "own/2" in (tmp_path / "out/glass_vision.md").read_text()
    assert main([str(tmp_path / "weights"), str(tmp_path / "out"), "--folder", str(tmp_path / "nowhere")]) == 2
    assert "There is no folder" in capsys.readouterr().err
