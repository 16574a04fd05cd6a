#!/usr/bin/env bash
# Makes a keystore as SROS2 lays it out: one CA for identities and permissions, a governance that protects all there is, and enclaves.
#   keystore.sh DIR ENCLAVE [TOPIC…]   an enclave that may publish and subscribe to these DDS topics; the CA is made with the first one
# VALID is the identity's life in days; with a negative one it has ended. UNTIL is when the permissions end. PARTITION is one that they
# grant beside the default one.
set -euo pipefail

dir=$1 enclave=$2
shift 2
days=${VALID:-1}
ca=$dir/private/ca
say() { printf '%s\n' "$@"; }
sign() { openssl smime -sign -text -in "$1.xml" -out "$1.p7s" -signer "$ca.cert.pem" -inkey "$ca.key.pem"; }
key() { openssl ecparam -name prime256v1 -genkey -noout -out "$1" && chmod 600 "$1"; }
domains='<domains><id_range><min>0</min><max>230</max></id_range></domains>'

mkdir -p "$dir/private" "$dir/enclaves$enclave"
if [ ! -e "$ca.cert.pem" ]; then
    key "$ca.key.pem"
    openssl req -x509 -new -key "$ca.key.pem" -subj "/CN=sros2CA ${dir##*/}" -days 3650 -out "$ca.cert.pem"
    say '<?xml version="1.0" encoding="UTF-8"?>' "<dds><domain_access_rules><domain_rule>$domains" \
        '<allow_unauthenticated_participants>false</allow_unauthenticated_participants>' \
        '<enable_join_access_control>true</enable_join_access_control>' \
        '<discovery_protection_kind>ENCRYPT</discovery_protection_kind>' \
        '<liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>' \
        '<rtps_protection_kind>SIGN</rtps_protection_kind>' \
        '<topic_access_rules><topic_rule><topic_expression>*</topic_expression>' \
        '<enable_discovery_protection>true</enable_discovery_protection>' \
        '<enable_liveliness_protection>true</enable_liveliness_protection>' \
        '<enable_read_access_control>true</enable_read_access_control>' \
        '<enable_write_access_control>true</enable_write_access_control>' \
        '<metadata_protection_kind>ENCRYPT</metadata_protection_kind>' \
        '<data_protection_kind>ENCRYPT</data_protection_kind>' \
        '</topic_rule></topic_access_rules></domain_rule></domain_access_rules></dds>' >"$dir/enclaves/governance.xml"
    sign "$dir/enclaves/governance"
fi

at=$dir/enclaves$enclave
cp "$ca.cert.pem" "$at/identity_ca.cert.pem"
cp "$ca.cert.pem" "$at/permissions_ca.cert.pem"
cp "$dir/enclaves/governance.p7s" "$at/governance.p7s"
key "$at/key.pem"
# `openssl x509` takes a negative number of days, and none for the beginning.
openssl req -new -key "$at/key.pem" -subj "/CN=${enclave//\//\\/}" |
    openssl x509 -req -CA "$ca.cert.pem" -CAkey "$ca.key.pem" -CAcreateserial -days "$days" -out "$at/cert.pem"
topics=$(printf '<topic>%s</topic>' "$@")
partitions=${PARTITION:+<partitions><partition></partition><partition>$PARTITION</partition></partitions>}
say '<?xml version="1.0" encoding="UTF-8"?>' "<dds><permissions><grant name=\"$enclave\"><subject_name>CN=$enclave</subject_name>" \
    '<validity><not_before>2020-01-01T00:00:00</not_before><not_after>'"${UNTIL:-2100-01-01T00:00:00}"'</not_after></validity>' \
    "<allow_rule>$domains<publish><topics>$topics</topics>$partitions</publish><subscribe><topics>$topics</topics>$partitions</subscribe></allow_rule>" \
    '<default>DENY</default></grant></permissions></dds>' >"$at/permissions.xml"
sign "$at/permissions"
