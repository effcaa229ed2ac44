# README's commands in a container:  docker build -t ganlane . && docker run --rm ganlane evaluate agents=mobil traffics=idm episodes=4
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends g++ git && rm -rf /var/lib/apt/lists/*
# PyTorch for CPUs; leave this line out for CUDA.
RUN pip install --no-cache-dir "torch>=2.11,<2.14" --index-url https://download.pytorch.org/whl/cpu
COPY . /ganlane
RUN pip install --no-cache-dir /ganlane
WORKDIR /work
ENTRYPOINT ["ganlane"]
CMD ["train", "traffic=gan", "init=idm_ckpt"]
