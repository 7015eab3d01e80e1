"""Pictures of an unmodified task, from one of its own cameras."""

from __future__ import annotations

import atexit

import numpy as np

from aegis_cli.sim.scene import SIZE, SLOW_FLAGS

import mujoco  # isort: skip  (after scene, which chooses the OpenGL backend)

_MOST_GEOMS = 2000  # capacity of a scene; the suite's largest has fewer


class Screen:
    """One rendering context for all environments of a task.

    It renders any environment whose model is compiled from the same source as `model`; the values
    in the models may differ.

    Args:
        camera: index of the model's camera that takes the pictures.
    """

    def __init__(self, model: mujoco.MjModel, camera: int = 0) -> None:
        # The context reads these from the model when it is created. Multisampling would be slow.
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
        self._gl = mujoco.GLContext(SIZE, SIZE)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, _MOST_GEOMS)
        for flag in SLOW_FLAGS:
            self._scene.flags[flag] = False
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        self._camera.type, self._own_camera = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        self._area = mujoco.MjrRect(0, 0, SIZE, SIZE)
        # Later, during interpreter shutdown, EGL is gone and closing raises.
        atexit.register(self._close)

    def render(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: int | None = None
    ) -> np.ndarray:
        """Picture [64, 64, 3] uint8 of one environment's state.

        Args:
            camera: index of a camera of the model; None for the screen's own.
        """
        self._gl.make_current()
        self._camera.fixedcamid = self._own_camera if camera is None else camera
        # Terrain is regenerated in each episode, but drawn from the context's copy.
        for field in range(model.nhfield):
            mujoco.mjr_uploadHField(model, self._context, field)
        mujoco.mjv_updateScene(
            model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        mujoco.mjr_render(self._area, self._scene, self._context)
        picture = np.empty((SIZE, SIZE, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._area, self._context)
        return np.ascontiguousarray(picture[::-1])

    def _close(self) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()
