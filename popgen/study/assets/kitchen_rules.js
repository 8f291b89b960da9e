// The rules of a kitchen, from the tables that popgen/envs/overcooked/exported_kitchen.py writes. Follows
// popgen/envs/overcooked/kernels.py function by function, where states are described; `popgen study check-browser`
// proves the two equal.

const COLUMNS = 256;

export class Kitchen {
  constructor(told) {
    this.told = told;
    this.names = told.names;
    this.table = Int16Array.from(told.table);
    this.values = Float32Array.from(told.values, Number);
    this.meta = told.meta;
    this.start = Uint8Array.from(told.start);
    this.size = this.start.length;
    this.features = told.meta[told.names.M_FEATURES];
    this.auto = told.meta[told.names.M_AUTO] === 1;
    this.raw = told.meta[told.names.M_RAW] === 1;
  }

  look(row, column) {
    return this.table[row * COLUMNS + column];
  }

  // Changes the state; gives the reward, soups paid for, and events by player (1 where one happened).
  step(state, actions) {
    const { INTERACT, HELD, TIME, UNPAID_DELIVERY, DELIVERS_SOUP, NO_EVENT, M_HORIZON } = this.names;
    let reward = this.values[0];
    let score = 0;
    const events = [new Uint8Array(this.told.events), new Uint8Array(this.told.events)];
    for (let player = 0; player < 2; player++) {
      if (actions[player] !== INTERACT) continue;
      const item = state[HELD + player];
      const event = this.interact(state, player);
      if (event < UNPAID_DELIVERY) events[player][event] = 1;
      if (event >= DELIVERS_SOUP && event < NO_EVENT) {
        reward = Math.fround(reward + this.values[item]);
        if (this.values[item] > 0) score++;
      }
    }
    this.move(state, actions[0], actions[1]);
    this.advancePots(state);
    const time = Math.min(state[TIME] + 256 * state[TIME + 1] + 1, 65535);
    state[TIME] = time & 255;
    state[TIME + 1] = time >> 8;
    return { reward, score, events, truncated: time >= this.meta[M_HORIZON] };
  }

  interact(state, player) {
    const names = this.names;
    const cell = this.look(names.FACE + (state[names.ORIENT + player] & 3), state[player]);
    const kind = this.look(names.KIND, cell);
    const slot = this.look(names.SLOT, cell);
    const held = names.HELD + player;
    const item = state[held];
    if (kind === names.POT) return this.usePot(state, held, slot);
    if (kind === names.COUNTER) {
      const there = state[slot];
      if ((item === 0) !== (there === 0)) {
        state[held] = there;
        state[slot] = item;
        if (this.raw && there !== 0) return this.counterPickupEvent(there);
      }
    } else if (kind === names.SERVE) {
      if (item >= names.FIRST_SOUP) {
        state[held] = 0;
        const delivery = this.look(names.DELIVERY, item);
        return delivery >= 0 ? delivery : names.UNPAID_DELIVERY;
      }
    } else if (item === 0 && kind === names.DISHES) {
      state[held] = names.DISH;
      return names.TAKES_DISH;
    } else if (item === 0 && kind !== names.WALL) {
      state[held] = kind === names.ONIONS ? names.ONION : names.TOMATO;
      return this.raw && kind === names.TOMATOES ? names.NO_EVENT : names.TAKES_INGREDIENT;
    }
    return names.NO_EVENT;
  }

  usePot(state, held, slot) {
    const names = this.names;
    const item = state[held];
    const contents = state[slot];
    const cooking = state[slot + 1];
    if (item === 0) {
      if (!this.auto && contents !== 0 && cooking === 0) state[slot + 1] = 1 + this.look(names.COOK, contents);
    } else if (item === names.DISH) {
      if (cooking === 1) {
        state[held] = contents;
        state[slot] = 0;
        state[slot + 1] = 0;
        return this.soupPickupEvent(contents);
      }
    } else if (item < names.DISH && cooking === 0) {
      const mixed = this.look(item === names.ONION ? names.ADD_ONION : names.ADD_TOMATO, contents);
      if (mixed > 0) {
        state[slot] = mixed;
        state[held] = 0;
        return names.POTS_INGREDIENT;
      }
    }
    return names.NO_EVENT;
  }

  counterPickupEvent(item) {
    if (item === this.names.DISH) return this.names.TAKES_DISH;
    return item >= this.names.FIRST_SOUP ? this.soupPickupEvent(item) : this.names.TAKES_INGREDIENT;
  }

  soupPickupEvent(soup) {
    return this.look(this.names.DELIVERY, soup) >= 0 ? this.names.TAKES_SOUP : this.names.NO_EVENT;
  }

  move(state, first, second) {
    const { ORIENT, NEXT, STAY } = this.names;
    const [old0, old1] = state;
    let [new0, new1] = [old0, old1];
    if (first < STAY) {
      state[ORIENT] = first;
      new0 = this.look(NEXT + first, old0);
    }
    if (second < STAY) {
      state[ORIENT + 1] = second;
      new1 = this.look(NEXT + second, old1);
    }
    if (new0 !== new1 && !(new0 === old1 && new1 === old0)) {
      state[0] = new0;
      state[1] = new1;
    }
  }

  advancePots(state) {
    const { POTS, M_POTS, FULL, COOK } = this.names;
    for (let slot = POTS; slot < POTS + 2 * this.meta[M_POTS]; slot += 2) {
      let cooking = state[slot + 1];
      if (this.auto && cooking === 0 && this.look(FULL, state[slot]) === 1) {
        cooking = 1 + this.look(COOK, state[slot]);
        state[slot + 1] = cooking;
      }
      if (cooking > 1) state[slot + 1] = cooking - 1;
    }
  }

  // `features` of both players, one after the other: (2 * F) numbers 0 or 1.
  encode(state, out = new Uint8Array(2 * this.features)) {
    out.fill(0);
    this.encodePlayers(state, out);
    this.encodeWorld(state, out);
    return out;
  }

  encodePlayers(state, out) {
    const { M_FLOOR, M_ITEM, FLOOR, ORIENT, HELD, ITEM_BIT } = this.names;
    const floor = this.meta[M_FLOOR];
    const items = this.meta[M_ITEM];
    for (let player = 0; player < 2; player++) {
      const mine = player * this.features;
      const theirs = this.features - mine;
      const cell = this.look(FLOOR, state[player]);
      if (cell >= 0) {
        out[mine + cell] = 1;
        out[theirs + floor + cell] = 1;
      }
      const side = 2 * floor + (state[ORIENT + player] & 3);
      out[mine + side] = 1;
      out[theirs + side + 4] = 1;
      const held = 2 * floor + 8;
      const item = state[HELD + player];
      if (item !== 0) this.setItem(out, mine + held, theirs + held + items, item, ITEM_BIT);
    }
  }

  encodeWorld(state, out) {
    const { M_FLOOR, M_ITEM, M_POTS, M_POT, M_COOK, M_COUNTERS, M_HORIZON } = this.names;
    const { POTS, POT_BIT, ITEM_BIT, TIME, URGENT_BELOW } = this.names;
    const other = this.features;
    let start = 2 * this.meta[M_FLOOR] + 8 + 2 * this.meta[M_ITEM];
    let slot = POTS;
    for (let pot = 0; pot < this.meta[M_POTS]; pot++) {
      const contents = state[slot];
      const cooking = state[slot + 1];
      if (contents !== 0) {
        this.setItem(out, start, other + start, contents, POT_BIT);
        if (cooking > 0 && cooking <= this.meta[M_COOK]) {
          out[start + this.meta[M_POT] + cooking - 1] = 1;
          out[other + start + this.meta[M_POT] + cooking - 1] = 1;
        }
      }
      start += this.meta[M_POT] + this.meta[M_COOK];
      slot += 2;
    }
    for (let counter = 0; counter < this.meta[M_COUNTERS]; counter++) {
      if (state[slot] !== 0) this.setItem(out, start, other + start, state[slot], ITEM_BIT);
      start += this.meta[M_ITEM];
      slot += 1;
    }
    if (this.meta[M_HORIZON] - (state[TIME] + 256 * state[TIME + 1]) < URGENT_BELOW) {
      out[start] = 1;
      out[other + start] = 1;
    }
  }

  setItem(out, at, other, item, row) {
    for (let place = row; place < row + 3; place++) {
      const bit = this.look(place, item);
      if (bit < 0) continue;
      out[at + bit] = 1;
      out[other + bit] = 1;
    }
  }
}

// Numbers of tiles by cell, of what popgen/study/browser_kitchen.py says there can be.
export function listTiles(kitchen, state) {
  const { names, meta, told: { tiles } } = kitchen;
  const cells = tiles.ground.slice();
  const counters = names.POTS + 2 * meta[names.M_POTS];
  tiles.pot_cells.forEach((cell, pot) => {
    const slot = names.POTS + 2 * pot;
    cells[cell] = tiles.pots[`${state[slot]},${state[slot + 1]}`] ?? cells[cell];
  });
  tiles.counter_cells.forEach((cell, counter) => {
    cells[cell] = tiles.counters[state[counters + counter]] ?? cells[cell];
  });
  for (const player of [0, 1]) {
    const hand = [player, state[names.ORIENT + player] & 3, state[names.HELD + player]];
    cells[state[player]] = tiles.players[hand.join(",")];
  }
  return cells;
}
