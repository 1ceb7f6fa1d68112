"""How the page looks: the style sheet that viser's own elements get."""

STYLE = """<style>
.mantine-Notification-root[style*="orange"] {display: none}  /* WebGL runs in software: true, and no help */
.banner {border-left: 12px solid; padding: 6px 18px; margin: 0 0 8px 0; line-height: 1.3}
.banner .title {font-size: 38px; font-weight: 700; line-height: 1.15}
.banner .detail {font-size: 18px; opacity: 0.85}
.banner .way {font-size: 26px; margin-top: 4px; font-variant-numeric: tabular-nums}
.banner .way span {display: inline-block; margin-right: 26px; white-space: nowrap}
.banner .way i {font-style: normal; opacity: 0.6}
@media (max-width: 1450px) {.banner .title {font-size: 30px} .banner .way {font-size: 20px}
  .banner .detail {font-size: 16px} .banner .way span {margin-right: 16px}}
.mantine-NumberInput-input {font-size: 14px !important; height: 32px; min-height: 32px; padding: 0 6px !important}
.mantine-NumberInput-section {display: none}
.banner .file {display: inline-block; font-size: 20px; margin: 8px 18px 4px 0; padding: 6px 14px; border-radius: 6px;
  background: #009E73; color: white; text-decoration: none}
.numbers {font-size: 18px; line-height: 1.4; padding: 2px 14px 8px 14px}
.numbers b {font-size: 24px}
.numbers .small {font-size: 14px; opacity: 0.7}
.legend {padding: 4px 18px 2px 18px; font-size: 14px}
.legend .bar {height: 14px; border-radius: 3px; margin-top: 4px}
.legend .marks {position: relative; height: 20px; margin-top: 2px}
.legend .marks span {position: absolute; transform: translateX(-50%); font-size: 13px}
div:has(> .mantine-Button-root) {display: inline-block; width: calc(50% - 15px); margin: 0 0 0 10px !important;
  padding-bottom: 8px !important; vertical-align: top}
div:has(> .mantine-Button-root[style*="#c8102e"]) {width: calc(100% - 20px)}
[data-dock-region="left"] [data-dock-column] > :first-child:empty {display: none}
.mantine-Button-root {height: 54px !important; font-size: 18px; padding: 0 4px; border-radius: 8px}
.mantine-Button-root .mantine-Button-label {white-space: normal; line-height: 1.1}
</style>"""

GO, PLAIN, STOP = (0, 158, 115), (82, 90, 104), (200, 16, 46)
"""Colours of buttons: the next thing to press, any other, the robot's."""

RIGHT = 350
"""Pixels: width of the panel with the buttons."""

LEFT = 300
"""Pixels: width of the panel with the pictures until the window's width is known."""

SHARE = 0.62
"""Part of what is left beside the buttons that the pictures get; the rest is the scene's."""
