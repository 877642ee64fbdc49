"""Build script; setup.cfg has the settings."""

from setuptools import setup

setup()
