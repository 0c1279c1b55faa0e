#!/usr/bin/env bash
# FMPy 0.3.32: the exit code of `fmpy validate` is the number of problems modulo 256.
#
# An FMU whose description has 256 problems is reported as "256 problems were found" and ends with exit code 0, so a
# pipeline that trusts the exit code passes. With 255 and 257 problems the exit codes are 255 and 1.
#
# Output seen:
#   255 problems: "255 problems were found:", exit code 255
#   256 problems: "256 problems were found:", exit code 0
#   257 problems: "257 problems were found:", exit code 1
#
# What to do: read the line that counts the problems, or call `fmpy.validation.validate_fmu`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check FMPy==0.3.32
for count in 255 256 257; do
    # One problem per input without a start value.
    python3 - "$count" "$folder/plate.fmu" <<'PYTHON'
import sys
import zipfile

count, path = int(sys.argv[1]), sys.argv[2]
variables = "".join(
    f'<ScalarVariable name="u{i}" valueReference="{i}" causality="input"><Real/></ScalarVariable>' for i in range(count)
)
description = (
    '<?xml version="1.0" encoding="UTF-8"?>'
    '<fmiModelDescription fmiVersion="2.0" modelName="plate" guid="{1}"><CoSimulation modelIdentifier="plate"/>'
    f"<ModelVariables>{variables}</ModelVariables><ModelStructure/></fmiModelDescription>"
)
with zipfile.ZipFile(path, "w") as archive:
    archive.writestr("modelDescription.xml", description)
PYTHON
    code=0
    "$folder/venv/bin/fmpy" validate "$folder/plate.fmu" >"$folder/output" 2>&1 || code=$?
    line=$(grep "problems were found" "$folder/output" || true)
    echo "$count problems: \"$line\", exit code $code"
    [ "$line" = "$count problems were found:" ] && [ "$code" = $((count % 256)) ]
done
