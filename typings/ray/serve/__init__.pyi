from collections.abc import Callable

class Application: ...

class Deployment:
    def bind(self) -> Application: ...

def ingress(app: Callable[[], object]) -> Callable[[], type]: ...
def deployment(
    _func_or_class: type,
    *,
    name: str,
    num_replicas: int,
    max_ongoing_requests: int,
    request_router_config: object,
) -> Deployment: ...
