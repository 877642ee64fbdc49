"""Build script of quadvel_description; setup.cfg has the metadata."""

from setuptools import setup

setup()
