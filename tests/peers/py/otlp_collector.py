"""A collector of metrics by OTLP over HTTP, with the messages that OpenTelemetry publishes for Python.

Prints its port, and then a line of JSON for each request that it takes.
"""

import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import (
    ExportMetricsServiceRequest,
    ExportMetricsServiceResponse,
)
from opentelemetry.proto.metrics.v1.metrics_pb2 import AGGREGATION_TEMPORALITY_CUMULATIVE

CONTENT_TYPE = "application/x-protobuf"


def pairs(attributes):
    return [[attribute.key, attribute.value.string_value] for attribute in attributes]


def described(metric):
    kind = metric.WhichOneof("data")
    data = getattr(metric, kind)
    if kind == "sum":
        assert data.is_monotonic and data.aggregation_temporality == AGGREGATION_TEMPORALITY_CUMULATIVE, metric
    points = []
    for point in data.data_points:
        assert point.WhichOneof("value") == "as_double", point
        points.append(
            {
                "labels": pairs(point.attributes),
                # As text, since not every reader of JSON rounds numbers correctly.
                "value": repr(point.as_double),
                "start": point.start_time_unix_nano,
                "time": point.time_unix_nano,
            }
        )
    return {
        "name": metric.name,
        "help": metric.description,
        "unit": metric.unit,
        "kind": kind,
        "points": points,
    }


class Collector(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self):
        assert self.headers["Content-Type"] == CONTENT_TYPE, self.headers
        request = ExportMetricsServiceRequest()
        request.ParseFromString(self.rfile.read(int(self.headers["Content-Length"])))
        [of_resource] = request.resource_metrics
        [of_scope] = of_resource.scope_metrics
        taken = {
            "path": self.path,
            "authorization": self.headers["Authorization"],
            "user_agent": self.headers["User-Agent"],
            "resource": dict(pairs(of_resource.resource.attributes)),
            "scope": [of_scope.scope.name, of_scope.scope.version],
            "metrics": [described(metric) for metric in of_scope.metrics],
        }
        print(json.dumps(taken), flush=True)
        body = ExportMetricsServiceResponse().SerializeToString()
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


server = ThreadingHTTPServer(("127.0.0.1", 0), Collector)
print(server.server_address[1], flush=True)
server.serve_forever()
