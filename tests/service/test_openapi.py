"""Requests made up from the OpenAPI document, right and wrong ones: none of them is the server's fault."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from tests.conftest import RunningServer

schemathesis: Any = pytest.importorskip("schemathesis")


def test_no_made_up_request_is_the_servers_fault(server: RunningServer) -> None:
    from schemathesis.checks import not_a_server_error
    from schemathesis.specs.openapi.checks import content_type_conformance, response_schema_conformance

    checks = (not_a_server_error, content_type_conformance, response_schema_conformance)
    schema = schemathesis.openapi.from_url(f"{server.url}/openapi.json")
    asked = set()
    for operation in (found.ok() for found in schema.get_all_operations()):

        @settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
        @given(case=operation.as_strategy())
        def ask(case: Any) -> None:
            asked.add(case.operation.label)
            case.validate_response(case.call(timeout=30), checks=checks)

        ask()
    assert len(asked) >= 15
    server.wait_until_ready()
