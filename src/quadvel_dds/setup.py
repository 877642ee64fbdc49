"""Build script of quadvel_dds; setup.cfg has the metadata."""

from setuptools import setup

setup()
