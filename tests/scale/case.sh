#!/bin/sh
# Stands for `ct2lut run ... --results RESULTS ... -- ID` in a simulation: `case.sh TEMPLATE run ...` leaves the finished
# results of TEMPLATE under the name ID, as hard links, and the run.json of a run of ID that came to its end.
template=$1
while [ $# -gt 0 ]; do
	case $1 in
	--results) results=$2 && shift 2 ;;
	--) id=$2 && shift 2 ;;
	*) shift ;;
	esac
done
folder=$results/$id
[ -d "$folder" ] || cp -al -- "$template" "$folder" || exit 30
sed "s/\"case_id\": \"[^\"]*\"/\"case_id\": \"$id\"/" "$template/run.json" >"$folder/.run.json" &&
	mv "$folder/.run.json" "$folder/run.json"
