"""The pages: home, one run, one live scene."""

from app.pages.render import Pages as Pages
from app.pages.routes import create_pages as create_pages
