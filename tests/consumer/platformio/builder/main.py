"""Builds a program by gcc."""

from SCons.Script import Default, DefaultEnvironment

env = DefaultEnvironment()
env.Replace(CC="gcc", CXX="g++", AR="ar", RANLIB="ranlib", PROGSUFFIX="")
env.Append(LIBS=["m"])
Default([env.BuildProgram()])
