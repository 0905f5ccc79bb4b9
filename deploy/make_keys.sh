#!/bin/sh
# Adds the keys of docker-compose.yml that are missing to .env in this folder; those that are there stay.
set -eu
umask 077
for name in KEY STATION_KEY DASHBOARD_KEY EVALUATION_KEY GRAFANA_PASSWORD; do
  if ! grep -q "^DEXTOUCH_$name=" .env 2>/dev/null; then
    echo "DEXTOUCH_$name=$(openssl rand -hex 32)" >> .env
  fi
done
echo "keys are in .env; sign in with: $(sed -n 's/^DEXTOUCH_KEY=//p' .env)"
