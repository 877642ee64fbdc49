"""Build script of quadvel_follow; setup.cfg has the metadata."""

from setuptools import setup

setup()
