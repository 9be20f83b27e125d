"""The panel of one session: layers and view."""

import threading
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import viser

from app.keys import LAYER_KEYS
from app.viewer.color.legend import swatches_html
from app.viewer.content.content import Content
from app.viewer.content.layers import (
    BLUE,
    GREEN,
    GREY,
    OBJECT_FORMS,
    PURPLE,
    RED,
    SKIN,
    TEAL,
    THEMES,
    YELLOW,
    Layers,
    Theme,
    next_form,
)
from app.viewer.scene.framing import Framing, pose_of_view
from app.viewer.scene.scene import grid_cell
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind
from physhandi.data.view import View

_BRAND = {False: (28, 80, 165), True: (36, 99, 203)}
"""Color of buttons on light and dark panels; both can be read (contrast of 4.5)."""


def set_theme(server: viser.ViserServer, *, dark: bool) -> None:
    """Dress the page."""
    server.gui.configure_theme(
        dark_mode=dark, show_logo=False, show_share_button=False, brand_color=_BRAND[dark]
    )


def legend_of(content: Content, layers: Layers) -> str:
    """Say as HTML what the colors of the parts mean that are shown.

    What has the colors of the recording, as surfaces and clouds can, is not among them.
    """
    has_object, is_colored = content.fitted is not None, layers.color != "plain"
    is_marked = content.markers is not None or (
        content.tracks is not None and content.tracks.node is not None
    )
    controls = "control points" if content.hands or content.markers is None else "grippers"
    holds = (layers.controls or layers.all_controls) and content.control is not None
    forces = layers.forces and has_object
    has_changes = content.fitted is not None and not content.fitted.model.is_always_attached
    red = [name for name, is_shown in (("controls", holds), ("forces", forces)) if is_shown]
    observed = content.observed
    is_green = observed is not None and not observed.is_colored
    entries = (
        (SKIN["right"], "hand", layers.hands and bool(content.hands or content.skeletons)),
        (BLUE, "object nodes", layers.nodes and has_object and not is_colored),
        (RED, ", ".join(red) if has_object else controls, bool(red)),
        (TEAL, "contact begins", forces and has_changes),
        (PURPLE, "contact ends", forces and has_changes),
        (YELLOW, "virtual springs", layers.virtual_springs and has_object and not is_colored),
        (GREEN, "markers" if is_marked else "observed", layers.observed and is_green),
        (GREY, "cameras", layers.cameras and bool(content.views) and layers.looks_from is None),
    )
    shown = [(color, text) for color, text, is_shown in entries if is_shown]
    return swatches_html(shown, is_list=False)


_OVERVIEW = "Overview"
_HINTS = {
    "splats": "The object as the cameras saw it, best before their video (View from); key 0. Where "
    "colors mean a quantity, and in comparisons, its surface is shown in their place"
}


def _grid_label(content: Content, framing: Framing) -> str:
    """Name the grid by the distance of its lines, which is the scale of the scene."""
    cell = grid_cell(framing.extent)
    if not content.is_metric:
        return f"Grid, {cell:g} {content.length_unit}{'' if cell == 1 else 's'}"
    return f"Grid, {cell:g} m" if cell >= 1 else f"Grid, {1e3 * cell:g} mm"


class LayersPanel:
    """Shown layers, and cameras to look from."""

    def __init__(self, server: viser.ViserServer, guard: Guard, redraw: Callable[[], None]) -> None:
        """Add the switches where the caller stands; `replace` shows those that are needed."""
        self._server = server
        self._guard = guard
        self._redraw = redraw
        self._layers = Layers()
        self._content: Content | None = None
        self._switches: dict[str, viser.GuiCheckboxHandle] = {}
        self._views: dict[str, View] = {}
        self._framing: Framing | None = None
        # Two quick presses of a key are heard in threads of their own.
        self._turn = threading.Lock()
        gui = server.gui
        for field, label in (
            ("hands", "Hands"),
            ("nodes", "Object nodes"),
            ("surface", "Surface"),
            ("splats", "Splats"),
            ("controls", "Control nodes"),
            ("all_controls", "All control nodes"),
            ("virtual_springs", "Virtual springs"),
            ("object_springs", "Object springs"),
            ("forces", "Force arrows"),
            ("observed", "Observed points"),
            ("cameras", "Cameras"),
            ("ground", "Grid"),
        ):
            switch = gui.add_checkbox(label, initial_value=True, hint=_HINTS.get(field))
            switch.on_update(guard.by_user(self._switch(field)))
            self._switches[field] = switch
        self._scale = gui.add_slider(
            "Arrow scale", 0.1, 5.0, 0.1, 1.0, hint="Length of the force arrows"
        )
        self._scale.on_update(guard.by_user(self._rescale))
        self._place: Any = gui.add_dropdown("View from", (_OVERVIEW,))
        self._place.on_update(guard.by_user(self._look))
        self._theme = gui.add_dropdown("Background", THEMES)
        self._theme.on_update(guard.by_user(lambda _: self._dress()))
        bind(server, guard, "layer", lambda _, number: self._press(LAYER_KEYS[number][0]))
        bind(server, guard, "form", lambda _, __: self._next_form())
        bind(server, guard, "theme", lambda _, __: self._turn_theme())
        self._prefers_dark = False

    def replace(self, content: Content, layers: Layers, framing: Framing) -> None:
        """Show the switches that a content needs, as its layers stand."""
        self._layers, self._framing, self._content = layers, framing, content
        layers.dark, layers.force_scale = self._is_dark, self._scale.value
        has_object = content.fitted is not None
        has_control = content.control is not None
        is_there = {
            "hands": bool(content.hands or content.skeletons),
            "nodes": has_object,
            "surface": content.surface is not None,
            "splats": content.splats is not None,
            "controls": has_control,
            "all_controls": has_object,
            "virtual_springs": has_object,
            "object_springs": has_object,
            "forces": has_object,
            "observed": content.observed is not None,
            "cameras": bool(content.views),
            "ground": True,
        }
        for field, switch in self._switches.items():
            switch.visible = is_there[field]
            switch.value = getattr(layers, field)
        is_marked = content.markers is not None
        self._switches["controls"].label = "Grippers" if is_marked else "Control nodes"
        has_names = is_marked or (content.tracks is not None and content.tracks.node is not None)
        self._switches["observed"].label = "Markers" if has_names else "Observed points"
        self._switches["ground"].label = _grid_label(content, framing)
        self._scale.visible = has_object
        self._views = {view.name: view for view in content.views}
        self._place.options = (_OVERVIEW, *self._views)
        self._place.value = layers.looks_from or _OVERVIEW
        self._place.visible = bool(self._views)

    @property
    def theme(self) -> tuple[Theme, bool]:
        """The background that was chosen, and whether the browser asks for a dark one."""
        return self._theme.value, self._prefers_dark

    @property
    def _is_dark(self) -> bool:
        return self._prefers_dark if self._theme.value == THEMES[0] else self._theme.value == "dark"

    def prefer_dark(self, *, on: bool) -> None:
        """Follow the browser, unless a background was chosen."""
        if on != self._prefers_dark:
            self._prefers_dark = on
            self._dress()

    def restore(self, layers: Layers, theme: Theme, *, prefers_dark: bool) -> None:
        """Show what another session shows of the same content."""
        self._theme.value, self._prefers_dark = theme, prefers_dark
        self._scale.value = layers.force_scale
        for field in fields(layers):
            setattr(self._layers, field.name, getattr(layers, field.name))
        for field, switch in self._switches.items():
            switch.value = getattr(layers, field)
        self._place.value = layers.looks_from or _OVERVIEW
        self._dress()

    def reset_view(self, event: Any) -> None:
        """Put the camera of the client that asks for it back to the overview."""
        self._place.value = _OVERVIEW
        self._look(event)

    def _press(self, field: str) -> None:
        """Switch a layer by its key, if there is anything in it."""
        switch = self._switches[field]
        with self._turn:
            if switch.visible:
                switch.value = not switch.value
                setattr(self._layers, field, switch.value)
        self._redraw()

    def _next_form(self) -> None:
        """Show the object as the next of what it can be shown as, and as nothing else."""
        with self._turn:
            if self._content is None or self._content.fitted is None:
                return
            chosen = next_form(self._layers, self._content)
            for form in OBJECT_FORMS:
                setattr(self._layers, form, form == chosen)
                self._switches[form].value = form == chosen
        self._redraw()

    def _turn_theme(self) -> None:
        with self._turn:
            self._theme.value = "light" if self._is_dark else "dark"
            self._dress()

    def _switch(self, field: str) -> Callable[[Any], None]:
        def switch(event: Any) -> None:
            setattr(self._layers, field, event.target.value)
            self._redraw()

        return switch

    def _dress(self) -> None:
        self._layers.dark = self._is_dark
        set_theme(self._server, dark=self._layers.dark)
        self._redraw()

    def _rescale(self, event: Any) -> None:
        self._layers.force_scale = event.target.value
        self._redraw()

    def _look(self, event: Any) -> None:
        view = self._views.get(self._place.value)
        self._layers.looks_from = view.name if view is not None else None
        self._redraw()
        self.place(event.client)

    def place(self, client: viser.ClientHandle) -> None:
        """Put the camera of a client where the view is that is looked from, or to the overview."""
        framing = self._framing
        if framing is None:
            return
        view = self._views.get(self._place.value)
        if view is not None:
            pose_of_view(view, framing).give(client)
            return
        eye = client.camera
        with client.atomic():
            eye.up_direction = (0.0, 0.0, 1.0)
            eye.fov = framing.fov
            eye.position, eye.look_at = framing.camera, framing.look_at
