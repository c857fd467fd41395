#!/bin/sh
# A map saved and reopened on another day: sh examples/saved_map.sh OUT
set -eu
out=${1:?"a folder for the runs and the map"}
flocc simulate corridor --out "$out/monday" --quiet
flocc map save "$out/monday" --out "$out/town"      # logs, latents, solution: one folder
flocc map info "$out/town"
flocc simulate corridor --seed 9 --map "$out/town" --map-fixed --out "$out/tuesday" --quiet
flocc doctor "$out/tuesday"
