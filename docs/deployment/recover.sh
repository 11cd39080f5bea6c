#!/usr/bin/env bash
# Bring PostgreSQL back to a moment of the past, in a new folder: from a base backup and the archive
# of its log. Nothing of either, or of the server that runs now, is changed.
#
#   recover.sh BASE ARCHIVE DATA MOMENT [PORT]
#
#   BASE     folder that pg_basebackup made before that moment
#   ARCHIVE  folder that archive_command copies the log to
#   DATA     folder of the new server, missing or empty
#   MOMENT   a time with its zone, such as "2026-11-28 12:00:00+00", or a restore point that
#            pg_create_restore_point made, such as point:before_cleaning
#   PORT     of the new server (5432)
#
# Options that the old server was given on its command line, such as "-c max_connections=500", belong
# into the variable PGOPTS. Run it as the user who runs PostgreSQL, with the programs of its version on PATH.
set -euo pipefail

fail() {
    echo "recover.sh: $*" >&2
    exit 2
}

[ $# -ge 4 ] && [ $# -le 5 ] || fail "usage: recover.sh BASE ARCHIVE DATA MOMENT [PORT]"
base=$1 archive=$2 data=$3 moment=$4 port=${5:-5432}
[ -f "$base/PG_VERSION" ] || fail "$base is no base backup. Name the folder that pg_basebackup made."
[ -d "$archive" ] || fail "$archive is no folder. Name the one that archive_command copies to."
if [ -e "$data" ] && [ -n "$(ls -A "$data")" ]; then
    fail "$data is not empty, and nothing is overwritten. Name another folder."
fi
# a link would be copied as one, and the new server would write where the backup's files are
for path in "$base/pg_wal" "$base"/pg_tblspc/*; do
    [ ! -L "$path" ] || fail "$path is a link: this script copies no tablespaces, and no log that is elsewhere."
done
archive=$(realpath "$archive")
case "$archive$moment" in *[\'\"\\%\$\`]*) fail "quotes, %, \$ and backslashes in ARCHIVE or MOMENT are refused." ;; esac
case "$moment" in
    point:?*) target="recovery_target_name = '${moment#point:}'" ;;
    *) target="recovery_target_time = '$moment'" ;;
esac
for program in pg_ctl pg_controldata; do
    command -v "$program" > /dev/null || fail "$program is not on PATH. Add PostgreSQL's folder of programs."
done

echo "copying $base"
mkdir -p -m 700 "$data"
cp -a "$base/." "$data"
chmod 700 "$data"
rm -f "$data/postmaster.pid"
cat >> "$data/postgresql.auto.conf" <<SETTINGS
restore_command = 'cp "$archive/%f" "%p"'
$target
recovery_target_action = 'promote'
# its log is another one from here on: archive it to a new folder
archive_mode = 'off'
# who followed the other server does not follow this one
synchronous_standby_names = ''
SETTINGS
touch "$data/recovery.signal"

echo "recovering to $moment"
pg_ctl -D "$data" -o "-p $port ${PGOPTS:-}" -l "$data/recovery.log" -w -t 86400 start > /dev/null 2>&1 ||
    fail "it did not start: $(grep -A 2 FATAL "$data/recovery.log" | head -n 3 | tr '\n\t' '  ')"
until pg_controldata "$data" | grep -q "cluster state: *in production"; do
    pg_ctl -D "$data" status > /dev/null ||
        fail "it ended before that moment: $(grep -A 2 FATAL "$data/recovery.log" | head -n 3 | tr '\n\t' '  ')"
    sleep 0.2
done
grep "last completed transaction" "$data/recovery.log" || true
echo "recovered: $data serves port $port"
