#!/bin/sh
# Usage: check_symbols.sh NM LIBRARY.a
# The packet codecs need a few functions of libc and libm only (no heap, no files, no threads), and hold no writable data.
set -eu
nm=$1 static=$2
allowed='^(mem(cpy|move|set|cmp)|bcmp|sin|cos|sincos|__stack_chk_fail|__(memcpy|memset)_chk|_GLOBAL_OFFSET_TABLE_)$'

defined=$("$nm" "$static" | awk 'NF == 3 && $2 ~ /[TtRr]/ { print $3 }' | sort -u)
[ -n "$defined" ] || { echo "no symbols in $static"; exit 1; }
foreign=$("$nm" "$static" | awk 'NF == 2 && $1 == "U" { print $2 }' | sort -u | grep -vxF "$defined" | grep -vE "$allowed" || true)
# Tables that hold pointers are written once, by the loader: .data.rel.ro.
writable=$("$nm" -f sysv "$static" | awk -F '|' '$3 ~ /[BbDdCcSsGg]/ && $7 !~ /^\.data\.rel\.ro/ { print $1, $7 }')
global=$("$nm" "$static" | awk 'NF == 3 && $2 == "T" { print $3 }' | grep -vE '^(upb|packet|wire)_' || true)
status=0
for finding in foreign writable global; do
    eval "names=\$$finding"
    [ -z "$names" ] || { echo "$finding symbols:"; echo "$names"; status=1; }
done
[ $status -eq 0 ] && echo "$(printf '%s\n' "$defined" | wc -l) symbols: none foreign, none writable"
exit $status
