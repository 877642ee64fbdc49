"""Build script of quadvel_sim; setup.cfg has the metadata."""

from setuptools import setup

setup()
