"""PlatformIO: the tables of the project's option `custom_selfcal_tables`, else the default ones."""

import os

Import("env")

tables = env.GetProjectOption("custom_selfcal_tables", "")
folder = os.path.join(env.subst("$PROJECT_DIR"), tables) if tables else os.path.realpath("default")
if not os.path.isfile(os.path.join(folder, "selfcal_model.c")):
    raise SystemExit(f"selfcal: {folder} has no selfcal_model.c: `selfcal codegen MODEL.yaml -o {tables}` makes it")
env.Append(CPPPATH=[folder])
env.Replace(SRC_FILTER=["+<*.c>", f"+<{os.path.relpath(folder)}/selfcal_model.c>"])
