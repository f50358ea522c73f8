"""Opens a page in a browser without a screen and saves what is seen: `browser.py URL PNG [SCRIPT]`.

The script runs in the page once something is drawn in its middle. Needs PySide6.
"""

import os
import sys

os.environ["QT_QPA_PLATFORM"] = "offscreen"
os.environ["QTWEBENGINE_DISABLE_SANDBOX"] = "1"
os.environ["QTWEBENGINE_CHROMIUM_FLAGS"] = (
    "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist"
)

from PySide6.QtCore import QTimer, QUrl
from PySide6.QtWebEngineWidgets import QWebEngineView
from PySide6.QtWidgets import QApplication

WIDTH, HEIGHT = 1100, 700
# Milliseconds. At first splats are not sorted: without a GPU that takes a while.
SETTLED = 9000


def main(url, picture, script=""):
    app = QApplication([])
    view = QWebEngineView()
    view.resize(WIDTH, HEIGHT)
    view.load(QUrl(url))
    view.show()

    def look():
        # A notice that there is no GPU covers part of the picture.
        view.page().runJavaScript(
            "for (const b of document.querySelectorAll('.mantine-Notification-closeButton'))"
            " b.click()"
        )
        seen = view.grab().toImage()
        across = range(WIDTH // 3, 2 * WIDTH // 3)
        if all(seen.pixelColor(x, HEIGHT // 2).lightness() > 240 for x in across):
            QTimer.singleShot(500, look)
        else:
            QTimer.singleShot(SETTLED, act)

    def act():
        view.page().runJavaScript(script)
        QTimer.singleShot(2000, finish)

    def finish():
        view.grab().save(picture)
        app.quit()

    QTimer.singleShot(500, look)
    QTimer.singleShot(100_000, lambda: app.exit(1))
    return app.exec()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
