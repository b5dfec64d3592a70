#!/bin/sh
# Usage: check_symbols.sh NM LIBRARY.a
# The daemon's core needs nothing but upbeam's own libraries and a few functions of libc (no heap, no files, no
# threads), and holds no writable data.
set -eu
nm=$1 library=$2
allowed='^(upb_[a-z0-9_]+|mem(cpy|move|set|cmp)|bcmp|str(cmp|len)|__stack_chk_fail|__(memcpy|memset)_chk|_GLOBAL_OFFSET_TABLE_)$'

defined=$("$nm" "$library" | awk 'NF == 3 && $2 ~ /[TtRr]/ { print $3 }' | sort -u)
[ -n "$defined" ] || { echo "no symbols in $library"; exit 1; }
foreign=$("$nm" "$library" | awk 'NF == 2 && $1 == "U" { print $2 }' | sort -u | grep -vxF "$defined" | grep -vE "$allowed" || true)
writable=$("$nm" "$library" | awk 'NF == 3 && $2 ~ /[BbDdCcSsGg]/ { print $2, $3 }')
[ -z "$foreign$writable" ] || { echo "foreign: $foreign"; echo "writable: $writable"; exit 1; }
echo "$(printf '%s\n' "$defined" | wc -l) symbols: none foreign, none writable"
