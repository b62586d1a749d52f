# One image for every container of docker-compose.yml.
#   docker build -t loopwright .
# BASE_IMAGE: any glibc system with `python` 3.11 or newer, venv and pip. No syntax line: it would pull an image.
ARG BASE_IMAGE=python:3.12-slim

FROM ${BASE_IMAGE} AS build
RUN python -c 'import sys, platform, venv, ensurepip; sys.exit(sys.version_info < (3, 11) or platform.libc_ver()[0] != "glibc")' \
    || { echo "BASE_IMAGE needs \`python\` 3.11 or newer with venv, on glibc; python:3.12-slim has it" >&2; exit 1; }
WORKDIR /source
RUN python -m venv /opt/loopwright
COPY pyproject.toml constraints.txt ./
# The dependencies first: this layer is used again as long as these two files stay.
RUN python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; extras = p["optional-dependencies"]; print("\n".join(p["dependencies"] + extras["service"] + extras["plot"]))' > needed.txt \
    && /opt/loopwright/bin/pip install --no-cache-dir --quiet --constraint constraints.txt --requirement needed.txt
COPY README.md LICENSE ./
COPY tuning tuning
COPY protocol protocol
COPY plantsim plantsim
COPY controller controller
COPY service service
COPY containers containers
COPY src src
# Without pip and the libraries' own tests, which nobody runs in here.
RUN /opt/loopwright/bin/pip install --no-cache-dir --quiet --no-deps . \
    && /opt/loopwright/bin/pip uninstall --quiet --yes pip setuptools 2>/dev/null \
    ; find /opt/loopwright/lib -type d -name tests -prune -exec rm -rf {} + \
    && /opt/loopwright/bin/loopwright --help > /dev/null

FROM ${BASE_IMAGE}
COPY --from=build /opt/loopwright /opt/loopwright
COPY containers/loops.yaml /etc/loopwright/loops.yaml
# New volumes take the owners of the folders they are put on.
RUN echo "loopwright:x:10001:10001::/data:/usr/sbin/nologin" >> /etc/passwd && echo "loopwright:x:10001:" >> /etc/group \
    && mkdir --parents /data /run/postgresql && chown 10001:10001 /data /run/postgresql
ENV PATH=/opt/loopwright/bin:$PATH PYTHONUNBUFFERED=1 MPLCONFIGDIR=/tmp
USER loopwright
WORKDIR /data
EXPOSE 8080
HEALTHCHECK --interval=5s --timeout=5s --start-period=60s --retries=3 CMD ["python", "-m", "loopwright.containers.health", "service"]
CMD ["loopwright", "serve", "--loops", "/etc/loopwright/loops.yaml", "--data", "/data"]
