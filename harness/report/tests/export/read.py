"""Reads an exported file with a library that is not the bench's and prints what is in it, as JSON.

Doubles are printed as their 64 bits in hexadecimal, so that equal means equal; a missing one is null.
"""

import json
import struct
import sys


def bits(values):
    return [None if value is None else struct.pack(">d", float(value)).hex() for value in values]


def parquet(path):
    import duckdb
    import pyarrow.parquet

    text = lambda pairs: {key.decode(): value.decode() for key, value in (pairs or {}).items()}
    fields = {field.name: text(field.metadata) for field in pyarrow.parquet.read_table(path).schema}
    db = duckdb.connect()
    table = db.execute("select * from read_parquet(?)", [path])
    columns = {name: (str(kind), []) for name, kind, *_ in table.description}
    for row in table.fetchall():
        for (kind, values), value in zip(columns.values(), row):
            values.append(value)
    shown = {
        name: {"kind": kind, "values": bits(values) if kind == "DOUBLE" else values}
        for name, (kind, values) in columns.items()
    }
    pairs = db.execute("select decode(key), decode(value) from parquet_kv_metadata(?)", [path]).fetchall()
    groups = db.execute("select distinct row_group_id from parquet_metadata(?)", [path]).fetchall()
    return {"columns": shown, "metadata": dict(pairs), "row_groups": len(groups), "fields": fields}


def mf4(path):
    from asammdf import MDF

    with MDF(path) as mdf:
        (group,) = mdf.groups
        channels = {}
        for channel in group.channels:
            # By name alone, as people do.
            signal = mdf.get(channel.name, raw=True)
            real = signal.samples.dtype.kind == "f"
            channels[channel.name] = {
                "unit": signal.unit,
                "comment": signal.comment,
                "discrete": bool(channel.flags & 1 << 8),
                "master": channel.channel_type == 2 and channel.sync_type == 1,
                "times": bits(signal.timestamps),
                "values": bits(signal.samples) if real else [bool(value) for value in signal.samples],
            }
        name = group.channel_group.acq_name
        return {
            "version": mdf.version,
            "start": mdf.header.start_time.timestamp(),
            "comment": mdf.header.comment,
            "history": [history.comment for history in mdf.file_history],
            "group": {"name": name, "comment": group.channel_group.comment, "channels": channels},
        }


def mcap(path):
    from mcap.reader import make_reader

    topics, schemas, metadata, times = {}, {}, {}, []
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            schemas[schema.name] = json.loads(schema.data)
            topic = topics.setdefault(channel.topic, {"about": dict(channel.metadata), "messages": []})
            row = json.loads(message.data)
            row = {name: value if isinstance(value, bool) else bits([value])[0] for name, value in row.items()}
            times.append(message.log_time)
            topic["messages"].append({"log_time": message.log_time, "row": row})
        for record in reader.iter_metadata():
            metadata[record.name] = dict(record.metadata)
        count = reader.get_summary().statistics.message_count
    return {"topics": topics, "schemas": schemas, "metadata": metadata, "count": count, "ordered": times == sorted(times)}


def csv(path):
    import duckdb

    db = duckdb.connect()
    table = db.execute("select * from read_csv(?)", [path])
    names = [name for name, *_ in table.description]
    kinds = {name: str(kind) for name, kind, *_ in table.description}
    rows = [[bits([value])[0] if kinds[name] == "DOUBLE" else value for name, value in zip(names, row)] for row in table.fetchall()]
    return {"kinds": kinds, "rows": rows}


if __name__ == "__main__":
    print(json.dumps({"parquet": parquet, "mf4": mf4, "mcap": mcap, "csv": csv}[sys.argv[1]](sys.argv[2])))
