// Runs the program of a partner from its safetensors file, bit for bit as popgen/policies/program_runner.py does:
// float64, each sum in the order of its terms, nothing but + - * / and square roots. Operations are described in
// popgen/policies/portable_program.py, arithmetic in portable_kernels.py.

const LEAK = Math.fround(0.01);
const [LOG2_E, LN2_HIGH, LN2_LOW] = [1.4426950408889634, 6.9314718036912381649e-1, 1.90821492927058770002e-10];
const POWERS = new Float64Array(1021).fill(1);
for (let k = 1; k < POWERS.length; k++) POWERS[k] = POWERS[k - 1] * 0.5;
const FACTORS = new Float64Array(14);
for (let n = 0, product = 1; n < FACTORS.length; n++, product *= n) FACTORS[n] = 1 / product;

function exp(x) { // of x <= 0
  if (!(x > -700)) return 0;
  const power = Math.floor(x * LOG2_E + 0.5);
  const rest = x - power * LN2_HIGH - power * LN2_LOW;
  let total = FACTORS[13];
  for (let n = 12; n >= 0; n--) total = total * rest + FACTORS[n];
  return power < 0 ? total * POWERS[-power] : total;
}

function sigmoid(x) {
  if (x >= 0) return 1 / (1 + exp(-x));
  const share = exp(x);
  return share / (1 + share);
}

function tanh(x) {
  const share = exp(-2 * Math.abs(x));
  const value = (1 - share) / (1 + share);
  return x >= 0 ? value : -value;
}

const activations = {
  tanh,
  leaky_relu: (x) => (x >= 0 ? x : x * LEAK),
  silu: (x) => x * sigmoid(x),
};

// A file is the length of its header (8 bytes), the header as JSON, then the numbers; all are float32 here.
export function readTensors(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const { __metadata__: metadata, ...entries } = header;
  const tensors = {};
  for (const [name, entry] of Object.entries(entries)) {
    if (entry.dtype !== "F32") throw new Error(`${name} is ${entry.dtype}, not F32`);
    const [begin, end] = entry.data_offsets;
    tensors[name] = { shape: entry.shape, values: new Float32Array(buffer.slice(8 + length + begin, 8 + length + end)) };
  }
  return { metadata, tensors };
}

// numpy's SFC64 from its state, four whole numbers as text.
export class Generator {
  constructor(words) {
    this.words = words.map(BigInt);
  }

  uniform() {
    const wrap = (value) => BigInt.asUintN(64, value);
    const [a, b, c, counter] = this.words;
    const drawn = wrap(a + b + counter);
    this.words = [b ^ (b >> 11n), wrap(c + (c << 3n)), wrap((wrap(c << 24n) | (c >> 40n)) + drawn), wrap(counter + 1n)];
    return Number(drawn >> 11n) / 9007199254740992;
  }
}

function fillProbabilities(logits, share, out) {
  const count = logits.length;
  let most = logits[0];
  for (let a = 1; a < count; a++) most = Math.max(most, logits[a]);
  let total = 0;
  for (let a = 0; a < count; a++) {
    out[a] = exp(logits[a] - most);
    total += out[a];
  }
  for (let a = 0; a < count; a++) out[a] = (out[a] / total) * (1 - share) + share / count;
  return out;
}

function invertDistribution(probabilities, uniform) {
  let total = 0;
  let last = 0;
  for (let a = 0; a < probabilities.length; a++) {
    total += probabilities[a];
    if (probabilities[a] > 0) last = a;
  }
  const wanted = uniform * total;
  let passed = 0;
  for (let a = 0; a < probabilities.length; a++) {
    passed += probabilities[a];
    if (wanted < passed) return a;
  }
  return last;
}

// One partner in one seat.
export class Partner {
  constructor(buffer, actions, features) {
    const { metadata, tensors } = readTensors(buffer);
    const program = JSON.parse(metadata.program);
    this.actions = actions;
    this.features = features;
    this.tensors = tensors;
    this.operations = program.operations;
    this.vectors = { obs: features, both: 2 * features, seat: 2, own: actions, other: actions, joint: 2 * actions };
    Object.assign(this.vectors, program.memories);
    for (const [name, size] of Object.entries(this.vectors)) this.vectors[name] = new Float64Array(size);
    this.memories = Object.keys(program.memories);
    this.probabilities = new Float64Array(actions);
    this.turned = {};
  }

  begin(seat, words) {
    this.seat = seat;
    this.generator = new Generator(words);
    this.held = {};
    this.vectors.seat.fill(0);
    this.vectors.seat[seat] = 1;
    for (const name of this.memories) this.vectors[name].fill(0);
  }

  // both: `features` of both players; previous: actions of the last step, null where there was none.
  act(both, previous) {
    const vectors = this.vectors;
    vectors.both.set(both);
    vectors.obs.set(both.subarray(this.seat * this.features, (this.seat + 1) * this.features));
    for (const name of ["own", "other", "joint"]) vectors[name].fill(0);
    if (previous) {
      vectors.own[previous[this.seat]] = 1;
      vectors.other[previous[1 - this.seat]] = 1;
      vectors.joint[previous[0]] = 1;
      vectors.joint[this.actions + previous[1]] = 1;
    }
    for (const operation of this.operations) this.run(operation);
    return this.action;
  }

  vector(name, size) {
    return (this.vectors[name] ??= new Float64Array(size));
  }

  run(operation) {
    const of = operation.of.map((name) => this.vectors[name]);
    const kind = operation.op;
    if (kind === "linear") this.linear(operation, of[0]);
    else if (kind === "norm") this.norm(operation, of[0]);
    else if (kind in activations) {
      const out = this.vector(operation.into, of[0].length);
      for (let i = 0; i < out.length; i++) out[i] = activations[kind](of[0][i]);
    } else if (kind === "join") {
      const out = this.vector(operation.into, of.reduce((sum, one) => sum + one.length, 0));
      let at = 0;
      for (const one of of) {
        out.set(one, at);
        at += one.length;
      }
    } else if (kind === "add" || kind === "times") {
      const out = this.vector(operation.into, of[0].length);
      for (let i = 0; i < out.length; i++) out[i] = kind === "add" ? of[0][i] + of[1][i] : of[0][i] * of[1][i];
    } else if (kind === "gru") this.gru(of[0], of[1], this.vectors[operation.into]);
    else if (kind === "norm_gru") this.normGru(of[0], this.vectors[operation.into]);
    else if (kind === "modes") this.modes(of[0], operation);
    else if (kind === "hold") this.hold(of[0], operation);
    else if (kind === "draw") this.draw(of[0], operation);
    else throw new Error(`there is no operation ${kind}`);
  }

  // Rows of the matrix by input, so that inputs of 0 are left out.
  turn(name) {
    if (!(name in this.turned)) {
      const { shape: [outputs, inputs], values } = this.tensors[name];
      const turned = new Float32Array(values.length);
      for (let o = 0; o < outputs; o++) for (let i = 0; i < inputs; i++) turned[i * outputs + o] = values[o * inputs + i];
      this.turned[name] = turned;
    }
    return this.turned[name];
  }

  linear(operation, values) {
    const weight = this.turn(operation.weight);
    const size = this.tensors[operation.weight].shape[0];
    const out = this.vector(operation.into, size);
    if (operation.bias) out.set(this.tensors[operation.bias].values);
    else out.fill(0);
    for (let i = 0; i < values.length; i++) {
      const value = values[i];
      if (value === 0) continue;
      const at = i * size;
      for (let o = 0; o < size; o++) out[o] += weight[at + o] * value;
    }
  }

  norm(operation, values) {
    const out = this.vector(operation.into, values.length);
    const scale = this.tensors[operation.weight].values;
    const shift = this.tensors[operation.bias].values;
    let total = 0;
    for (const value of values) total += value;
    const mean = total / values.length;
    let squares = 0;
    for (const value of values) squares += (value - mean) * (value - mean);
    const deviation = Math.sqrt(squares / values.length + operation.eps);
    for (let i = 0; i < out.length; i++) out[i] = ((values[i] - mean) / deviation) * scale[i] + shift[i];
  }

  gru(inputs, recurrent, memory) {
    const units = memory.length;
    for (let u = 0; u < units; u++) {
      const reset = sigmoid(inputs[u] + recurrent[u]);
      const update = sigmoid(inputs[units + u] + recurrent[units + u]);
      const candidate = tanh(inputs[2 * units + u] + reset * recurrent[2 * units + u]);
      memory[u] = candidate + update * (memory[u] - candidate);
    }
  }

  normGru(gates, memory) {
    const units = memory.length;
    for (let u = 0; u < units; u++) {
      const candidate = tanh(sigmoid(gates[u]) * gates[units + u]);
      const update = sigmoid(gates[2 * units + u] - 1);
      memory[u] = memory[u] + update * (candidate - memory[u]);
    }
  }

  modes(logits, operation) {
    const out = this.vector(operation.into, logits.length).fill(0);
    const groups = logits.length / operation.classes;
    for (let g = 0; g < groups; g++) {
      let best = 0;
      for (let c = 1; c < operation.classes; c++) if (logits[c * groups + g] > logits[best * groups + g]) best = c;
      out[best * groups + g] = 1;
    }
  }

  hold(logits, operation) {
    const { into, least, most } = operation;
    const out = this.vector(into, logits.length);
    if (!this.held[into]) {
      const probabilities = fillProbabilities(logits, 0, new Float64Array(logits.length));
      out.fill(0);
      out[invertDistribution(probabilities, this.generator.uniform())] = 1;
      this.held[into] = least + Math.floor(this.generator.uniform() * (most - least + 1));
    }
    this.held[into] -= 1;
  }

  draw(logits, operation) {
    if (operation.greedy) {
      this.action = logits.indexOf(logits.reduce((most, value) => Math.max(most, value)));
      return;
    }
    fillProbabilities(logits, operation.unimix, this.probabilities);
    this.action = invertDistribution(this.probabilities, this.generator.uniform());
  }
}
