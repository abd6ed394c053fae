#!/bin/sh
# Builds the wheel and tries it alone: installed with its core dependencies (in the locked versions) in an empty
# environment, it analyses a copy of the shipped record from another folder. Prints and limits the installed size.
set -eu
cd "$(dirname "$0")/.."
limit=750 # MB, of the core without extras
root=$(pwd)
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT

# hatchling as locked; from the source distribution, so that this is tried, too
rm -rf out/wheel
"$root/.venv/bin/uv" build --quiet --offline --no-build-isolation --python "$root/.venv/bin/python" --out-dir out/wheel
wheel=$(ls "$root"/out/wheel/fitact-*.whl)

# constraints without hashes, since the wheel itself has none; what uv has cached is not fetched again
sed -e 's/ \\$//' -e '/^    --hash/d' requirements/all.txt >"$place/locked.txt"
"$root/.venv/bin/uv" venv --quiet --python "$root/.venv/bin/python" "$place/env"
"$root/.venv/bin/uv" pip install --quiet --python "$place/env/bin/python" --constraint "$place/locked.txt" "$wheel${1:+[$1]}"

size=$(du -sm "$place/env" | cut -f1)
echo "wheel: $(basename "$wheel"), $(du -k "$wheel" | cut -f1) kB; installed with its dependencies${1:+ and [$1]}: $size MB"
if [ -z "${1:-}" ] && [ "$size" -ge "$limit" ]; then
    echo "wheel: the core needs $size MB, $limit MB or more; find the dependency that grew" >&2
    exit 1
fi

mkdir "$place/elsewhere"
cp data_synth/records/finger_direct.csv data_synth/records/finger_direct.toml "$place/elsewhere"
cd "$place/elsewhere"
fitact="$place/env/bin/python -I $place/env/bin/fitact"
$fitact run finger_direct.csv --scene finger_direct.toml --out results --seed 1 >/dev/null
for file in summary.json fit.json posterior.nc report.html chain.h5; do
    test -s "results/$file" || { echo "wheel: fitact run left no $file" >&2; exit 1; }
done
# what lies beside the code: templates and scripts were in the report; scenes, thresholds and advice
printf '[perception]\nthresholds = "fingertip"\n' >felt.toml
$fitact scene phone >/dev/null
$fitact scene felt.toml >/dev/null
$fitact explain prior-limited >/dev/null
"$place/env/bin/python" -I -c 'import fitact, pathlib, sys; folder = pathlib.Path(fitact.__file__).parent
sys.exit(not ((folder / "py.typed").exists() and folder.is_relative_to(sys.prefix)))'
echo "wheel: fitact run, scene and explain work from it alone"
