# Everything, without a ROS installation: docker build -t fluoro_calib . && docker run -it fluoro_calib
# Shared memory carries images between nodes: docker run --shm-size 512m ...
FROM python:3.12-slim-bookworm

RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ git make \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home lab && install --directory --owner lab /opt/fluoro_calib_ros
USER lab
WORKDIR /opt/fluoro_calib_ros
COPY --chown=lab . .
RUN make setup

ENV PATH=/opt/fluoro_calib_ros/.venv/bin:$PATH
CMD ["make", "demo"]
