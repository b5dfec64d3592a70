#!/bin/sh
# Usage: check_symbols.sh NM LIBRARY.a [LIBRARY.so]
# The library needs nothing but a few functions of libc and libm (no heap, no files, no threads), holds no writable data,
# and exports nothing but upb_ names.
set -eu
nm=$1 static=$2 shared=${3:-}

# What the compiler may call on its own is there too: memory and stack protection, the table of a shared object.
allowed='^(mem(cpy|move|set|cmp)|bcmp|str(len|ncat|ncpy)|floorf|getauxval|__stack_chk_fail|__(memcpy|memset|strncat|strncpy)_chk|_GLOBAL_OFFSET_TABLE_)$'

defined=$("$nm" "$static" | awk 'NF == 3 && $2 ~ /[TtRr]/ { print $3 }' | sort -u)
[ -n "$defined" ] || { echo "no symbols in $static"; exit 1; }
needed=$("$nm" "$static" | awk 'NF == 2 && $1 == "U" { print $2 }' | sort -u)
foreign=$(printf '%s\n' "$needed" | grep -vxF "$defined" | grep -vE "$allowed" || true)
writable=$("$nm" "$static" | awk 'NF == 3 && $2 ~ /[BbDdCcSsGg]/ { print $2, $3 }')
exported=$([ -z "$shared" ] || "$nm" -D --defined-only "$shared" | awk '{ print $NF }' | grep -vE '^upb_' || true)
internal=$([ -z "$shared" ] || "$nm" -D --defined-only "$shared" | awk '{ print $NF }' | grep -E '^upb_(kernels_|fail|check_memory|offset_)' || true)

status=0
for finding in "foreign" "writable" "exported" "internal"; do
    eval "names=\$$finding"
    if [ -n "$names" ]; then
        echo "$finding symbols:"
        echo "$names"
        status=1
    fi
done
[ $status -eq 0 ] && echo "$(printf '%s\n' "$defined" | wc -l) symbols: none foreign, none writable"
exit $status
