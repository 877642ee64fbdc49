"""Install script for colcon; setup.cfg declares the package."""

from setuptools import setup

setup()
