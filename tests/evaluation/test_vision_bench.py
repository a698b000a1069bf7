"""The command that judges vision on the virtual lab."""

import cv2
import torch

from zsdt.evaluation.vision_bench import lab_images, main
from zsdt.lab.styles import Pool
from zsdt.perception.unet import UNet, UNetOptions
from zsdt.perception.unet_weights import save_unet


def test_untrained_weights_fail_and_the_report_says_so(tmp_path, capsys):
    threads = torch.get_num_threads(), cv2.getNumThreads()
    torch.manual_seed(0)
    options = UNetOptions([4, 4])
    save_unet(tmp_path / "weights", UNet(options), options, {})
    try:
        status = main([str(tmp_path / "weights"), str(tmp_path / "out"), "--images", "1", "--threads", "1"])
        assert status == 1
        assert "| iou | at least 0.9 |" in capsys.readouterr().out
        assert {p.name for p in (tmp_path / "out").iterdir()} == {
            "vision.csv",
            "vision.json",
            "vision.md",
            "worst.png",
            "typical.png",
        }
        assert main([str(tmp_path / "nowhere"), str(tmp_path / "out"), "--images", "1", "--threads", "1"]) == 2
        assert main([str(tmp_path / "out")]) == 2
        assert "stage train_vision" in capsys.readouterr().err
    finally:
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])


def test_training_and_judging_pictures_of_the_lab_are_different_and_labelled():
    train, unseen = lab_images(0, 1, Pool.train), lab_images(0, 1, Pool.unseen)
    assert (train.images[0] != unseen.images[0]).any()
    assert 0.005 < (train.masks[0] > 127).mean() < 0.3
